//! The agent's ends of the wire: a lease on worlds, hidden states for scores, beliefs for those who look on.

pub mod client;
pub mod errors;
pub mod feed;
pub mod info;
pub mod launch;
pub mod truth;
