//! Benchmarks: runs policies on the same worlds, and scores them against the hidden states.

pub(crate) mod compare;
pub(crate) mod compared_worlds;
pub mod report;
mod run_tally;
