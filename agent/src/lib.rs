//! The Emberwatch agent.

pub mod client;
pub mod report;
