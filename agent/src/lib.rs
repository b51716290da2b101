//! Estimates, plans and acts on an Emberwatch server.

pub mod belief;
pub mod estimator;
pub mod planner;

pub use belief::{Belief, EntropyKind};
pub use planner::{Objective, Planner, PlanningProblem};
