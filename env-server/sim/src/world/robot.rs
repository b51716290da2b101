//! One robot of a world: its position, its last path and its last frame.

use super::outcome::RobotOutcome;
use emberwatch_model::{Airspace, Cell, Coverage, Frame, Move};

#[derive(Debug, Clone)]
pub struct Robot {
    pub(super) outcome: RobotOutcome,
    pub(super) frame: Frame,
    pub(super) path: Vec<Move>,
    /// Row-major indices of the distinct cells of the path, in the order of the first visit.
    pub(super) visited: Vec<usize>,
    /// Row-major indices of the cells that the sensor sees from the visited cells.
    pub(super) seen: Vec<usize>,
}

/// Reusable buffers for flights, with arbitrary content between calls.
#[derive(Debug, Clone, Default)]
pub struct Scratch {
    visited: Vec<u64>,
    is_seen: Vec<bool>,
}

/// Returns the memory in bytes of a robot with its next path, if the robot sees up to `most_seen` of `n_cells` cells.
pub fn bytes_of_robot(n_moves: usize, most_seen: usize, n_cells: usize) -> usize {
    let of_path = n_moves * (2 * size_of::<Move>() + size_of::<usize>());
    let of_sight = most_seen * size_of::<usize>();
    size_of::<Robot>() + n_cells + of_path + of_sight
}

impl Robot {
    pub(super) fn at(airspace: &Airspace, cell: Cell) -> Self {
        let mut robot = Self {
            outcome: RobotOutcome::at(cell),
            frame: Frame::empty(airspace.shape()),
            path: Vec::new(),
            visited: Vec::new(),
            seen: Vec::new(),
        };
        robot.follow(airspace, &[], Coverage::Empty, &mut Scratch::default());
        robot
    }

    /// Flies a path, or stays if the path is empty. The caller must then set the frame and the rewards.
    pub(super) fn follow(
        &mut self,
        airspace: &Airspace,
        path: &[Move],
        coverage: Coverage,
        scratch: &mut Scratch,
    ) {
        let start = self.cell();
        let end = airspace.fly_into(start, path, &mut self.visited, &mut scratch.visited);
        airspace.see_into(&self.visited, &mut self.seen, &mut scratch.is_seen);
        self.path.clear();
        self.path.extend_from_slice(path);
        self.frame.clear();
        self.outcome = RobotOutcome {
            n_visited: self.visited.len() as u32,
            start,
            coverage,
            n_moves: path.len() as u32,
            ..RobotOutcome::at(end)
        };
    }

    pub fn outcome(&self) -> &RobotOutcome {
        &self.outcome
    }

    pub fn frame(&self) -> &Frame {
        &self.frame
    }

    /// Returns the path of the last step. Empty after a reset or if the robot stayed.
    pub fn path(&self) -> &[Move] {
        &self.path
    }

    pub fn cell(&self) -> Cell {
        self.outcome.cell
    }
}
