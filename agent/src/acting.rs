//! Acting on one world of a running server, and planning for a learner outside.

pub mod handover;
pub mod mission;
pub mod options;
pub mod pilot;
pub mod registry;
pub mod run;
