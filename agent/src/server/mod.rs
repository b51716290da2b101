//! The agent's ends of the wire: a lease on robots, hidden states for scores, beliefs for observers.

pub mod client;
pub mod errors;
pub mod feed;
pub mod info;
pub mod launch;
mod left_belief;
pub mod truth;
