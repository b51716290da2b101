//! Policies by name: which belief, which planner, which objective (the ladder of the benchmark).

mod list;
mod named;

pub use list::list;
pub use named::{Choice, EstimatorKind, PlannerKind, Policy, numbered_states};
