//! Policies by name: which belief, which planner, which objective (the ladder of the benchmark).

mod kinds;
mod list;
mod named;

pub use kinds::{Choice, EstimatorKind, PlannerKind, Policy, numbered_states};
pub use list::list;
