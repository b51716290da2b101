//! The interface of planners, which turn a value per cell into a path (paper section III.D).

use super::objective::CellValues;
use emberwatch_model::grid::Cell;
use emberwatch_model::path::Move;

/// The input of a planner.
#[derive(Debug, Clone, Copy)]
pub struct PlanningProblem<'a> {
    /// The robot's cell, which must be on the grid.
    pub start: Cell,
    pub n_moves: usize,
    pub values: &'a CellValues,
    /// Seed of the planner's random stream.
    pub seed: u64,
    /// The environment's step k. Each step has different random numbers.
    pub step: u64,
}

/// A planned path and its score.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// The path's `n_moves` moves.
    pub moves: Vec<Move>,
    /// The path's [`CellValues::score`], up to rounding.
    pub score: f32,
}

/// An algorithm that finds paths. The same problem always results in the same plan.
pub trait Planner {
    /// Plans a path of exactly `problem.n_moves` moves.
    fn plan(&mut self, problem: &PlanningProblem<'_>) -> Plan;
}
