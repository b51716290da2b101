//! Beliefs about a partly observed grid of hidden states, and plans based on these beliefs.
//!
//! The code is pure: frames, seeds and steps are arguments. It reads no clock and writes no log, and only
//! [`estimation::kept_belief`] accesses files.
//!
//! - [`estimation`]: from frames to a belief about every cell (paper sections III.A to III.C)
//! - [`planning`]: from a belief to a path (paper section III.D)
//! - [`merit`], [`brier`]: scores of a run and of a belief

#![allow(missing_docs, reason = "self-explanatory names need no docs")]

pub mod brier;
pub mod estimation;
pub mod merit;
pub mod planning;

pub use estimation::belief::{Belief, BeliefError, EntropyKind};
pub use estimation::{BayesFilter, Estimator, EstimatorError, SpatialFilter};
pub use planning::{Objective, Plan, Planner, PlanningProblem};
