//! What a step gives a world and its robots.

use emberwatch_model::{Cell, Coverage};

/// A world after a step or a reset, and what the step gave its robots together.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct WorldOutcome {
    /// Step index k after the step; 0 after a reset.
    pub step: u64,
    /// Seed of the episode.
    pub seed: u64,
    /// Number of resets of this world since the server started.
    pub episode: u64,
    /// Sum of rewards, in X_{k+1}, over the distinct cells that pay.
    pub reward: f64,
    /// Bit r is set if nobody held robot r: it stayed and saw nothing.
    pub hovered: u64,
    /// Bit r is set if robot r was held, but its path had not come by the deadline: it stayed and saw nothing.
    pub late: u64,
    /// Cells of the whole grid in the state that pays most.
    pub n_target_cells: u32,
    /// Distinct cells that any robot visited.
    pub n_visited: u32,
    /// Distinct paying cells in the state that pays most.
    pub n_hits: u32,
    /// Whether the episode ended by itself.
    pub is_terminated: bool,
    /// Whether it reached its last step.
    pub is_truncated: bool,
}

/// What a step gave one robot; also its place after a reset.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RobotOutcome {
    /// Its share of the world's reward: a cell that v robots visited pays each of them 1/v.
    pub reward: f64,
    /// What the world's reward would lack without this robot.
    pub marginal: f64,
    /// Distinct cells that it visited.
    pub n_visited: u32,
    /// Its distinct paying cells in the state that pays most.
    pub n_hits: u32,
    /// Where its path began, or where it stays.
    pub start: Cell,
    /// Where it is.
    pub cell: Cell,
    pub coverage: Coverage,
    /// Moves that it flew; 0 after a reset, and where it stayed.
    pub n_moves: u32,
}

impl RobotOutcome {
    /// Of a robot that stays in a cell.
    pub fn at(cell: Cell) -> Self {
        Self {
            reward: 0.0,
            marginal: 0.0,
            n_visited: 0,
            n_hits: 0,
            start: cell,
            cell,
            coverage: Coverage::Empty,
            n_moves: 0,
        }
    }
}
