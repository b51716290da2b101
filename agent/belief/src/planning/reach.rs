//! The [`Reach`]: the part of the grid that a path can reach, so that a plan's cost depends on the
//! path's length and not on the grid's size.

use crate::planning::planner::PlanningProblem;
use emberwatch_protocol::grid::Cell;
use emberwatch_protocol::path::Move;

/// The rectangle of cells within T rows and T columns of the start, with what they are worth.
///
/// Where it ends inside the grid no path of T moves gets past it, so clamping to the reach is
/// clamping to the grid.
#[derive(Debug, Default)]
pub(super) struct Reach {
    pub rows: usize,
    pub cols: usize,
    /// Where the robot starts, in reach coordinates.
    pub start: (usize, usize),
    /// Score of the first visit of each cell, and of each later visit; row-major.
    pub gains: Vec<[f32; 2]>,
}

impl Reach {
    /// Becomes the reach of a problem, keeping its memory.
    pub fn look_at(&mut self, problem: &PlanningProblem<'_>) {
        let (values, n_moves) = (problem.values, problem.n_moves);
        let shape = values.shape();
        let Cell { row, col } = problem.start;
        assert!(
            shape.contains(problem.start),
            "start {} is off the {shape} grid",
            problem.start
        );
        let (top, left) = (row.saturating_sub(n_moves), col.saturating_sub(n_moves));
        let bottom = (row + n_moves + 1).min(shape.height());
        let right = (col + n_moves + 1).min(shape.width());
        (self.rows, self.cols) = (bottom - top, right - left);
        self.start = (row - top, col - left);
        let bonus = values.coverage_bonus();
        let cells = values.value();
        let cells = cells.slice(ndarray::s![top..bottom, left..right]);
        let again = if values.revisits() { 1.0 } else { 0.0 };
        let gains = |&value: &f32| [value + bonus, again * value];
        self.gains.clear();
        self.gains.extend(cells.iter().map(gains));
    }

    pub fn n_cells(&self) -> usize {
        self.rows * self.cols
    }

    #[inline]
    pub fn index(&self, row: u32, col: u32) -> usize {
        row as usize * self.cols + col as usize
    }

    /// Where a move takes the robot; off the reach it stays, as [`Move::apply`] has it on the grid.
    #[inline]
    pub fn after(&self, step: Move, row: u32, col: u32) -> (u32, u32) {
        match step {
            Move::Up => (row.saturating_sub(1), col),
            Move::Down => ((row + 1).min(self.rows as u32 - 1), col),
            Move::Left => (row, col.saturating_sub(1)),
            Move::Right => (row, (col + 1).min(self.cols as u32 - 1)),
        }
    }
}
