//! Beliefs about a partly observed grid of hidden states, and plans based on these beliefs.
//!
//! Results depend only on arguments, such as frames, seeds and steps. The crate reads no clock and writes no log, and
//! only [`estimation::kept_belief`] accesses files.
//!
//! - [`estimation`]: from frames to a belief about every cell (paper sections III.A to III.C)
//! - [`planning`]: from a belief to a path (paper section III.D)
//! - [`merit`], [`brier`]: figures of merit of a run, and scores of a belief

#![allow(missing_docs, reason = "self-explanatory names need no docs")]

pub mod brier;
pub mod estimation;
pub mod merit;
pub mod planning;

pub use estimation::belief::{Belief, BeliefError};
pub use estimation::{BayesFilter, Estimator, EstimatorError, SpatialFilter};
pub use planning::{Objective, Plan, Planner, PlanningProblem};
