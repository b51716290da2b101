//! Acting on one world of a running server: for a policy, or for a learner outside.

pub mod decider;
pub mod decisions;
pub mod handover;
pub mod mission;
pub mod pilot;
pub mod registry;
pub mod run;
