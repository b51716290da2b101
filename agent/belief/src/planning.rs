//! Planners, which turn a value per cell into a path (paper section III.D).
//!
//! An [`Objective`] converts a belief into [`CellValues`]. A [`Planner`] then searches for the path with the highest
//! score, which is the negative of the cost in eq. 15 without its constant factor.

pub mod ahead;
pub mod beam;
pub mod memory;
pub mod objective;
pub mod options;
mod planner;
pub mod random_walk;
mod reach;
pub mod shooting;
pub mod team;
pub mod value_layers;

pub use ahead::Ahead;
pub use beam::BeamSearch;
pub use memory::Memory;
pub use objective::{CellValues, Objective, Target};
pub use options::{OPTIONS, OptionPlanner, PathOption, Proposal};
pub use planner::{Plan, Planner, PlanningProblem};
pub use random_walk::RandomWalk;
pub use shooting::{Integration, Shooting};
pub use value_layers::ValueLayers;
