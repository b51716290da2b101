//! What agents learn and what they act on: estimators with networks, learners, decisions, their checkpoints, and the
//! policies that put belief, planner and objective together. Pure but for checkpoints and kept beliefs in files: frames
//! in, paths out.
//!
//! Modules, each using only those below it:
//!
//! - [`options`] -- beliefs about worlds and the plan of every option, for a learner outside
//! - [`served`] -- the worlds of a client, as an environment
//! - [`learners`] -- what learns while it acts: filter, Algorithm 1, neural belief, decisions; reading checkpoints
//! - [`rollout`] -- an agent at its world, and the step that all commands take
//! - [`policy`] -- belief, planner and goal; names and parts of policies
//! - [`beliefs`] -- kinds of belief: constructors and facts, what was learned for them
//! - [`learned`] -- the contents of checkpoints, by type
//! - [`gradient`], [`replay`], [`reward`], [`checkpoint`] -- the parts of learners
//! - [`config`] -- settings
//! - [`mod@file`] -- files written whole or not at all
//! - [`parallel`] -- tasks of several worlds at once

#![allow(
    missing_docs,
    reason = "the agent's inside: what names say is not said again"
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
