//! Acting on one world of a running server.

pub mod handover;
pub mod mission;
pub mod pilot;
pub mod run;
