//! Learners: agents that learn while they act, and the checkpoints of what they learned. Only checkpoints use files.
//! Everything else performs no I/O: it receives frames and returns paths.
//!
//! Each module uses only the modules below it in this list:
//!
//! - [`learners`] -- learners that act: filter, Algorithm 1, neural belief, decisions; loading checkpoints
//! - [`gradient`], [`replay`], [`reward`] -- the building blocks of learners
//! - [`models`] -- learned models in checkpoints
//! - [`checkpoint`] -- files of tensors, counters and settings
//! - [`mod@file`] -- files that are written completely or not at all

#![allow(
    missing_docs,
    reason = "internals of the agent: only items that need an explanation are documented"
)]

pub mod checkpoint;
pub mod file;
pub mod gradient;
pub mod learners;
pub mod models;
pub mod replay;
pub mod reward;
