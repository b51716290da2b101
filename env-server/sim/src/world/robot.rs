//! One robot of a world: where it is, what it flew and what it saw.

use super::outcome::RobotOutcome;
use emberwatch_model::{Airspace, Cell, Coverage, Frame, Move};
use emberwatch_model::{Pays, SeenCell};

/// A robot after a step or a reset.
#[derive(Debug, Clone)]
pub struct Robot {
    pub(super) outcome: RobotOutcome,
    pub(super) frame: Frame,
    pub(super) path: Vec<Move>,
    /// The distinct cells of the path, row-major indices in the order of the first visit.
    pub(super) visited: Vec<usize>,
    /// The cells in sight of these.
    pub(super) seen: Vec<SeenCell>,
    /// Row-major indices of the distinct cells that pay, where these are not the visited ones.
    pub(super) paying: Option<Vec<usize>>,
}

/// Work space of flights, of any content.
#[derive(Debug, Clone, Default)]
pub struct Scratch {
    visited: Vec<u64>,
    rings: Vec<u8>,
}

/// The memory of a robot that flies `n_moves` moves and sees up to `most_seen` of `n_cells` cells, and of its path
/// before that is flown.
pub fn bytes_of_robot(n_moves: usize, most_seen: usize, n_cells: usize) -> usize {
    let of_path = n_moves * (2 * size_of::<Move>() + size_of::<usize>());
    let of_sight = most_seen * (size_of::<SeenCell>() + size_of::<usize>());
    size_of::<Robot>() + n_cells + of_path + of_sight
}

impl Robot {
    /// A robot after a reset.
    pub(super) fn at(airspace: &Airspace, cell: Cell) -> Self {
        let mut robot = Self {
            outcome: RobotOutcome::at(cell),
            frame: Frame::empty(airspace.shape()),
            path: Vec::new(),
            visited: Vec::new(),
            seen: Vec::new(),
            paying: None,
        };
        robot.fly(airspace, &[], Coverage::Empty, &mut Scratch::default());
        robot
    }

    /// Flies a path, or stays if it is empty; what the step pays is yet to be counted.
    pub(super) fn fly(
        &mut self,
        airspace: &Airspace,
        path: &[Move],
        coverage: Coverage,
        scratch: &mut Scratch,
    ) {
        let start = self.cell();
        let end = airspace.fly_into(start, path, &mut self.visited, &mut scratch.visited);
        airspace.see_into(&self.visited, &mut self.seen, &mut scratch.rings);
        self.paying = (airspace.pays() == Pays::Seen)
            .then(|| self.seen.iter().map(|seen| seen.cell).collect());
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

    /// What the last step gave it.
    pub fn outcome(&self) -> &RobotOutcome {
        &self.outcome
    }

    /// Row-major indices of the distinct cells that pay.
    pub(super) fn paying(&self) -> &[usize] {
        self.paying.as_ref().unwrap_or(&self.visited)
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
        self.outcome.cell
    }
}
