//! Acting on one world of a running server.

mod handover;
mod link;
pub mod mission;
mod pilot;
pub mod run;
pub mod team;
