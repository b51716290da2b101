//! Planners: from a value per cell to a path (paper section III.D).
//!
//! An [`Objective`] turns a belief into [`CellValues`] once; a [`Planner`] then looks for the path
//! with the best score, which is eq. 15 with the sign turned and without its constant factor.

pub mod ahead;
pub mod beam;
pub mod memory;
pub mod objective;
pub mod options;
pub mod outlook;
mod planner;
pub mod random_walk;
mod reach;
pub mod shooting;
pub mod team;

pub use ahead::Ahead;
pub use beam::BeamSearch;
pub use memory::Memory;
pub use objective::{BasisKind, CellValues, Objective, Target};
pub use options::{OPTIONS, OptionPlanner, PathOption, Proposal};
pub use outlook::Outlook;
pub use planner::{Plan, Planner, PlanningProblem};
pub use random_walk::RandomWalk;
pub use shooting::{Integration, Shooting};
