//! Policies by name: which belief, which planner, which objective (the ladder of the benchmark).

mod list;
mod named;
mod names;

pub use list::list;
pub use named::{EstimatorKind, PlannerKind, Policy, UnknownPolicy};
pub use names::{OF_AUTOENCODER, OF_DECISIONS, OF_FILTER, OF_OWN_FILTER};
