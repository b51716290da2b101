//! One robot of a world: where it is, what it flew and what it saw.

use emberwatch_protocol::message::RobotResult;
use emberwatch_protocol::path::fly_into;
use emberwatch_protocol::{Cell, Coverage, Frame, Move, Shape};

/// A robot after a step or a reset.
#[derive(Debug, Clone)]
pub struct Robot {
    pub(super) result: RobotResult,
    pub(super) frame: Frame,
    pub(super) path: Vec<Move>,
    /// The distinct cells of the path, row-major indices in the order of the first visit.
    pub(super) visited: Vec<usize>,
}

impl Robot {
    /// A robot after a reset.
    pub(super) fn at(shape: Shape, cell: Cell) -> Self {
        let mut robot = Self {
            result: RobotResult {
                row: cell.row as u32,
                col: cell.col as u32,
                ..RobotResult::default()
            },
            frame: Frame::empty(shape),
            path: Vec::new(),
            visited: Vec::new(),
        };
        robot.fly(shape, &[], Coverage::Empty, &mut Vec::new());
        robot
    }

    /// Flies a path, or stays if it is empty; what the step pays is yet to be counted. `seen` is scratch.
    pub(super) fn fly(
        &mut self,
        shape: Shape,
        path: &[Move],
        coverage: Coverage,
        seen: &mut Vec<u64>,
    ) {
        let start = self.cell();
        let end = fly_into(shape, start, path, &mut self.visited, seen);
        self.path.clear();
        self.path.extend_from_slice(path);
        self.frame.clear();
        self.result = RobotResult {
            n_visited: self.visited.len() as u32,
            start_row: start.row as u32,
            start_col: start.col as u32,
            row: end.row as u32,
            col: end.col as u32,
            coverage: coverage as u32,
            n_moves: path.len() as u32,
            ..RobotResult::default()
        };
    }

    /// What the last step gave it.
    pub fn result(&self) -> &RobotResult {
        &self.result
    }

    /// What it saw in the last step.
    pub fn frame(&self) -> &Frame {
        &self.frame
    }

    /// What it flew in the last step; empty after a reset, and if it stayed.
    pub fn path(&self) -> &[Move] {
        &self.path
    }

    /// Where it is.
    pub fn cell(&self) -> Cell {
        self.result.cell()
    }
}
