//! Learning agents: estimators with networks, learners, decisions, their checkpoints, and policies, which combine a
//! belief, a planner and a goal. Only checkpoints and cached first beliefs use files. Everything else performs no I/O:
//! it receives frames and returns paths.
//!
//! Each module uses only the modules below it in this list:
//!
//! - [`options`] -- beliefs about worlds and the plans of all options, for an external learner
//! - [`served`] -- the worlds of a client, as an environment
//! - [`learners`] -- learners that act: filter, Algorithm 1, neural belief, decisions; loading checkpoints
//! - [`rollout`] -- an agent with its world, and the step that all commands share
//! - [`policy`] -- policies by name, and their parts: belief, planner and goal
//! - [`beliefs`] -- kinds of belief: constructors, names and properties, learned models
//! - [`learned`] -- the values loaded from checkpoints, by type
//! - [`gradient`], [`replay`], [`reward`], [`checkpoint`] -- the building blocks of learners
//! - [`config`] -- settings
//! - [`mod@file`] -- files that are written completely or not at all
//! - [`parallel`] -- parallel computation for several worlds

#![allow(
    missing_docs,
    reason = "internals of the agent: only items that need an explanation are documented"
)]

pub mod beliefs;
pub mod checkpoint;
pub mod config;
pub mod file;
pub mod gradient;
pub mod learned;
pub mod learners;
pub mod options;
pub mod parallel;
pub mod policy;
pub mod replay;
pub mod reward;
pub mod rollout;
pub mod served;
