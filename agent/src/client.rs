//! The agent's ends of the wire: connections, hidden states for scores, beliefs for observers.

pub mod errors;
pub mod info;
pub mod launch;
pub mod left_belief;
pub mod truth;
pub mod view;
