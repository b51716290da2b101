//! The Emberwatch agent.
pub mod client;
