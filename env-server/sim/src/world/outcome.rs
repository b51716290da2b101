//! Outcomes of a step: results of a world and of its robots.

use emberwatch_model::{Cell, Coverage};

#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct WorldOutcome {
    /// Step index k after the step; 0 after a reset.
    pub step: u64,
    pub seed: u64,
    /// Number of resets of this world since the server started.
    pub episode: u64,
    /// Sum of the rewards of the distinct rewarded cells. A cell's reward depends on its state in X_{k+1}.
    pub reward: f64,
    /// Bit r is set if no client held robot r. Such a robot stays in its cell and observes nothing.
    pub hovered: u64,
    /// Bit r is set if robot r was held but its path missed the deadline. Such a robot stays in its cell and observes
    /// nothing.
    pub late: u64,
    /// Number of cells in the whole grid whose state has the highest reward.
    pub n_target_cells: u32,
    pub n_visited: u32,
    pub n_hits: u32,
    pub is_terminated: bool,
    pub is_truncated: bool,
}

/// The result of a step for a robot, or its position after a reset.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RobotOutcome {
    /// The robot's share of the world's reward: each of v robots that visited a cell gets 1/v of the cell's reward.
    pub reward: f64,
    /// Marginal reward: how much smaller the world's reward would be if this robot had not flown.
    pub marginal: f64,
    pub n_visited: u32,
    /// Number of the robot's distinct rewarded cells whose state has the highest reward.
    pub n_hits: u32,
    /// The cell where the robot's path started, or where the robot stayed.
    pub start: Cell,
    pub cell: Cell,
    pub coverage: Coverage,
    /// Number of moves flown; 0 after a reset and for a robot that stayed.
    pub n_moves: u32,
}

impl RobotOutcome {
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
