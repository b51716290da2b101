//! What agents learn and what they act on: estimators with networks, learners, decisions, their checkpoints, and the
//! policies that put belief, planner and objective together. Pure but for checkpoints and kept beliefs in files: frames
//! in, paths out.
//!
//! Modules, each using only those below it:
//!
//! - [`options`] -- beliefs about worlds and the plan of every option, for a learner outside
//! - [`registry`] -- a policy's agent: estimator, planner, and what decides
//! - [`learned`] -- what a checkpoint holds
//! - [`learners`] -- what learns while it acts: filter, networks of Algorithm 1, neural belief, decisions
//! - [`rollout`] -- an agent at its world, and the step that all commands take
//! - [`belief`], [`checkpoint`], [`filter`], [`replay`], [`reward`], [`update`] -- the parts of learners
//! - [`config`] -- settings
//! - [`policy`] -- policies by name
//! - [`estimation`] -- estimators that need networks; the others are in the crate `emberwatch-belief`
//! - [`mod@file`] -- files written whole or not at all

#![allow(
    missing_docs,
    reason = "the agent's inside: what names say is not said again"
)]

pub mod belief;
pub mod checkpoint;
pub mod config;
pub mod estimation;
pub mod file;
pub mod filter;
pub mod learned;
pub mod learners;
pub mod options;
pub mod policy;
pub mod registry;
pub mod replay;
pub mod reward;
pub mod rollout;
pub mod update;
