//! Estimates, plans and acts on an Emberwatch server, and compares ways to do so.
//!
//! One step, in reading order: [`client`] (frames in, paths out), [`estimator`] (frame to
//! [`belief`]), [`planner`] (belief to path).

pub mod action;
pub mod agent;
pub mod arena;
pub mod belief;
pub mod checkpoint;
pub mod client;
pub mod compare;
pub mod config;
pub mod decider;
pub mod decisions;
pub mod dqn_input;
pub mod estimator;
pub mod evaluate;
pub mod feed;
pub mod first_belief;
pub mod handover;
pub mod launch;
pub mod learned;
pub mod learner;
pub mod metrics;
pub mod planner;
pub mod policy;
pub mod replay;
pub mod report;
pub mod reward;
pub mod rollout;
pub mod run;
pub mod scoring;
pub mod student;
pub mod summary;
pub mod tensorboard;
pub mod train;
pub mod truth;

pub use belief::{Belief, EntropyKind};
pub use planner::{Objective, Planner, PlanningProblem};
