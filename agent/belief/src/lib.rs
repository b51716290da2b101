//! Beliefs about a grid of hidden states that robots see in part, and plans on them. Pure: frames, seeds and
//! steps come as arguments; no clock, no logging, and no files but for [`estimation::kept_belief`].
//!
//! - [`estimation`]: from frames to a belief about every cell (paper sections III.A to III.C)
//! - [`planning`]: from a belief to a path (paper section III.D)
//! - [`merit`], [`brier`]: how good a run and a belief were

#![allow(
    missing_docs,
    reason = "items that their names explain have no words of their own"
)]

pub mod brier;
pub mod estimation;
pub mod merit;
pub mod planning;

pub use estimation::belief::{Belief, BeliefError, EntropyKind};
pub use estimation::{BayesFilter, Estimator, EstimatorError, SpatialFilter};
pub use planning::{Objective, Plan, Planner, PlanningProblem};
