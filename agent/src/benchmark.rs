//! Benchmarks: runs policies on the same worlds, and scores them against the hidden states.

pub(crate) mod arena;
pub(crate) mod compare;
pub mod report;
mod world_run;
