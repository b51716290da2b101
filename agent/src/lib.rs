//! Estimates, plans and acts on an Emberwatch server, and compares ways to do so.
//!
//! One step, in reading order: [`client`] (frames in, paths out), [`estimator`] (frame to
//! [`belief`]), [`planner`] (belief to path).

pub mod belief;
pub mod client;
pub mod estimator;
pub mod planner;
pub mod report;

pub use belief::{Belief, EntropyKind};
pub use planner::{Objective, Planner, PlanningProblem};
