//! The [`Reach`] is the part of the grid that a path can reach. Planners search only this part, so their run time
//! depends on the path's length, not on the grid's size.

use crate::planning::planner::PlanningProblem;
use emberwatch_model::grid::Cell;
use emberwatch_model::path::Move;
use std::ops::Range;

/// The cells within T rows and columns of a path's start. No path of T moves crosses a border of the reach inside the
/// grid, so clamping moves to the reach has the same effect as clamping them to the grid.
#[derive(Debug, Default)]
pub(super) struct Reach {
    pub rows: usize,
    pub cols: usize,
    /// The start's row and column in the reach.
    pub start: (usize, usize),
    /// The score of the first visit and of each later visit to each cell, row-major. Minus infinity in no-fly cells.
    pub gains: Vec<[f32; 2]>,
    /// The cells in sight, if they count.
    pub sight: Option<Sight>,
}

#[derive(Debug)]
pub(super) struct Sight {
    radius: usize,
    rows: usize,
    cols: usize,
    first: (usize, usize),
    values: Vec<f32>,
}

impl Reach {
    /// Computes the reach of a problem. Reuses the buffers.
    pub fn look_at(&mut self, problem: &PlanningProblem<'_>) {
        let (values, n_moves) = (problem.values, problem.n_moves);
        let shape = values.shape();
        let Cell { row, col } = problem.start;
        assert!(
            shape.contains(problem.start),
            "start: expected a cell of the {shape} grid, got {}",
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
        let gains = |&value: &f32| [value + bonus, 0.0];
        self.gains.clear();
        self.gains.extend(cells.iter().map(gains));
        if let Some(map) = values.airspace().no_fly() {
            let blocked = map.slice(ndarray::s![top..bottom, left..right]);
            let all = self.gains.iter_mut().zip(blocked);
            let blocked = all.filter(|(_, blocked)| **blocked);
            blocked.for_each(|(gains, _)| *gains = [f32::NEG_INFINITY; 2]);
        }
        let radius = values.airspace().radius();
        self.sight = values.in_sight().map(|in_sight| {
            let (above, before) = (top.saturating_sub(radius), left.saturating_sub(radius));
            let below = (bottom + radius).min(shape.height());
            let behind = (right + radius).min(shape.width());
            let cells = in_sight.slice(ndarray::s![above..below, before..behind]);
            Sight {
                radius,
                rows: below - above,
                cols: behind - before,
                first: (top - above, left - before),
                values: cells.iter().copied().collect(),
            }
        });
    }

    pub fn n_cells(&self) -> usize {
        self.rows * self.cols
    }

    #[inline]
    pub fn index(&self, row: u32, col: u32) -> usize {
        row as usize * self.cols + col as usize
    }

    /// Returns the cell after a move. A move out of the reach leaves the robot in place.
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

impl Sight {
    pub fn n_cells(&self) -> usize {
        self.rows * self.cols
    }

    /// Returns the rows and columns that a move between two cells of the reach can show for the first time. If
    /// `was_seen` is set, the surroundings of the first cell have already been seen.
    #[inline]
    fn newly_seen(&self, from: (u32, u32), to: (u32, u32), was_seen: bool) -> [Range<usize>; 2] {
        let around = |at: u32, first: usize, side: usize| {
            let at = at as usize + first;
            at.saturating_sub(self.radius)..(at + self.radius + 1).min(side)
        };
        let rows = |row| around(row, self.first.0, self.rows);
        let cols = |col| around(col, self.first.1, self.cols);
        let (now, before) = ([rows(to.0), cols(to.1)], [rows(from.0), cols(from.1)]);
        if !was_seen {
            return now;
        }
        // A move changes the row or the column by one, so it adds cells at one end only.
        let added = |now: &Range<usize>, before: &Range<usize>| {
            if now.start < before.start {
                now.start..before.start
            } else {
                before.end..now.end
            }
        };
        if to.0 == from.0 {
            [now[0].clone(), added(&now[1], &before[1])]
        } else {
            [added(&now[0], &before[0]), now[1].clone()]
        }
    }

    /// Returns the value of the cells that a move shows for the first time. `seen` contains one bit for each cell.
    #[inline]
    pub fn gain(&self, seen: &[u64], from: (u32, u32), to: (u32, u32), was_seen: bool) -> f32 {
        let [rows, cols] = self.newly_seen(from, to, was_seen);
        let mut gain = 0.0;
        for row in rows {
            for cell in row * self.cols + cols.start..row * self.cols + cols.end {
                let is_new = seen[cell / 64] >> (cell % 64) & 1 == 0;
                gain += if is_new { self.values[cell] } else { 0.0 };
            }
        }
        gain
    }

    /// Marks the cells that a move shows as seen.
    pub fn mark(&self, seen: &mut [u64], from: (u32, u32), to: (u32, u32), was_seen: bool) {
        let [rows, cols] = self.newly_seen(from, to, was_seen);
        for row in rows {
            for cell in row * self.cols + cols.start..row * self.cols + cols.end {
                seen[cell / 64] |= 1 << (cell % 64);
            }
        }
    }
}
