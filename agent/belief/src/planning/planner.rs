//! What a planner is: a value per cell in, a path out (paper section III.D).

use super::objective::CellValues;
use emberwatch_model::grid::Cell;
use emberwatch_model::path::Move;

#[derive(Debug, Clone, Copy)]
pub struct PlanningProblem<'a> {
    /// Where the robot is; must lie on the grid.
    pub start: Cell,
    pub n_moves: usize,
    pub values: &'a CellValues,
    /// Seed of the planner's random stream.
    pub seed: u64,
    /// The environment's step k: each step has its own random numbers.
    pub step: u64,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// The moves, `n_moves` of them.
    pub moves: Vec<Move>,
    /// [`CellValues::score`] of the moves, up to rounding.
    pub score: f32,
}

/// Something that finds paths; the same problem always gets the same plan.
pub trait Planner {
    /// Plans a path of exactly `problem.n_moves` moves.
    fn plan(&mut self, problem: &PlanningProblem<'_>) -> Plan;
}
