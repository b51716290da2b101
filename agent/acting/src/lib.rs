//! Agents: beliefs, policies, which combine a belief, a planner and a goal, and the step of an agent in its world. Only
//! cached first beliefs use files. Everything else performs no I/O: it receives frames and returns paths.
//!
//! Each module uses only the modules below it in this list:
//!
//! - [`options`] -- beliefs about worlds and the plans of all options, for an external learner
//! - [`served`] -- the worlds of a client, as an environment
//! - [`rollout`] -- an agent with its world, and the step that all commands share
//! - [`policy`] -- policies by name, and their parts: belief, planner and goal
//! - [`beliefs`] -- kinds of belief: constructors, names and properties, learned models
//! - [`learned`] -- the values loaded from checkpoints, by type
//! - [`config`] -- settings
//! - [`parallel`] -- parallel computation for several worlds

#![allow(
    missing_docs,
    reason = "internals of the agent: only items that need an explanation are documented"
)]

pub mod beliefs;
pub mod config;
pub mod learned;
pub mod options;
pub mod parallel;
pub mod policy;
pub mod rollout;
pub mod served;
#[cfg(test)]
mod testing;
