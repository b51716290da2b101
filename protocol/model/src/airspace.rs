//! An [`Airspace`]: the cells where robots may fly, and the cells that they see from a path.

use super::grid::{Cell, Grid, Shape};
use super::path::{Flight, Move, fly_by};
use std::sync::Arc;

/// The cells where robots may fly, and the reach of their sensor.
#[derive(Debug, Clone, PartialEq)]
pub struct Airspace {
    shape: Shape,
    no_fly: Option<Arc<Grid<bool>>>,
    radius: usize,
}

impl Airspace {
    /// Makes an airspace without no-fly cells, with a sensor that sees only the cells of the path.
    pub fn open(shape: Shape) -> Self {
        Self::new(shape, None, 0)
    }

    /// Makes an airspace that is closed to robots in the cells set in `no_fly` (shape `[H, W]`).
    ///
    /// The sensor sees `radius` rows and columns beyond each cell of the path. With a radius of 0, a robot sees exactly
    /// the cells that it visits.
    ///
    /// # Panics
    /// If the shape of `no_fly` is not the grid's.
    pub fn new(shape: Shape, no_fly: Option<Arc<Grid<bool>>>, radius: usize) -> Self {
        let dim = no_fly.as_ref().map_or(shape.dim(), |map| map.dim());
        assert_eq!(dim, shape.dim(), "no_fly: expected the shape of the grid");
        Self {
            shape,
            no_fly: no_fly.filter(|map| map.iter().any(|closed| *closed)),
            radius,
        }
    }

    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// Returns the number of rows and columns that the sensor sees beyond each cell of the path, 0 to 8.
    pub fn radius(&self) -> usize {
        self.radius
    }

    pub fn is_open(&self) -> bool {
        self.no_fly.is_none()
    }

    /// Returns whether each cell is closed to robots, shape `[H, W]`. `None` if all cells are open.
    pub fn no_fly(&self) -> Option<&Arc<Grid<bool>>> {
        self.no_fly.as_ref()
    }

    #[inline]
    pub fn is_free(&self, cell: Cell) -> bool {
        !self
            .no_fly
            .as_ref()
            .is_some_and(|map| map[[cell.row, cell.col]])
    }

    /// Returns the cell that a move leads to. A move off the grid or into a no-fly cell leaves the robot in place.
    #[inline]
    pub fn after(&self, step: Move, cell: Cell) -> Cell {
        let next = step.apply(cell, self.shape);
        if self.is_free(next) { next } else { cell }
    }

    /// Returns the move, or, if it leads into a no-fly cell, the next one in [`Move::ALL`] that does not. Planners use
    /// it to avoid wasted moves.
    #[inline]
    pub fn around(&self, step: Move, cell: Cell) -> Move {
        let may_be = |step: &Move| self.is_free(step.apply(cell, self.shape));
        let mut steps = (0..4).map(|turn| Move::from_low_bits(step as u64 + turn));
        steps.find(may_be).unwrap_or(step)
    }

    /// Replaces each move of a path that leads into a no-fly cell with the result of [`Self::around`].
    pub fn fly_around(&self, start: Cell, path: &mut [Move]) {
        if self.is_open() {
            return;
        }
        let mut cell = start;
        for step in path {
            *step = self.around(*step, cell);
            cell = self.after(*step, cell);
        }
    }

    /// Flies a path from `start` (paper eq. 12). Each move is `z_{t+1} = z_t + v_t`, unless that cell is off the grid
    /// or closed to robots.
    pub fn fly(&self, start: Cell, path: &[Move]) -> Flight {
        let mut visited = Vec::new();
        let end = self.fly_into(start, path, &mut visited, &mut Vec::new());
        Flight { visited, end }
    }

    /// Flies a path as [`Self::fly`] does, but without allocating. Writes the visited cells to `visited`. `seen` is a
    /// scratch buffer; its content does not matter. Returns the robot's last cell.
    pub fn fly_into(
        &self,
        start: Cell,
        path: &[Move],
        visited: &mut Vec<usize>,
        seen: &mut Vec<u64>,
    ) -> Cell {
        if self.is_open() {
            let after = |step: Move, cell| step.apply(cell, self.shape);
            fly_by(after, self.shape, start, path, (visited, seen))
        } else {
            let after = |step, cell| self.after(step, cell);
            fly_by(after, self.shape, start, path, (visited, seen))
        }
    }

    /// Lists every cell that the sensor sees from the visited cells, each once, as row-major indices. `is_seen` is a
    /// scratch buffer; its content does not matter.
    pub fn see_into(&self, visited: &[usize], seen: &mut Vec<usize>, is_seen: &mut Vec<bool>) {
        seen.clear();
        if self.radius == 0 {
            seen.extend(visited);
            return;
        }
        is_seen.clear();
        is_seen.resize(self.shape.n_cells(), false);
        let (height, width) = self.shape.dim();
        let within = |at: usize, side: usize| {
            at.saturating_sub(self.radius)..(at + self.radius + 1).min(side)
        };
        for &index in visited {
            let Cell { row, col } = self.shape.cell(index);
            for near_row in within(row, height) {
                for near_col in within(col, width) {
                    let cell = near_row * width + near_col;
                    if !std::mem::replace(&mut is_seen[cell], true) {
                        seen.push(cell);
                    }
                }
            }
        }
    }

    /// Returns the cells that the sensor sees from the visited cells (see [`Self::see_into`]).
    pub fn see(&self, visited: &[usize]) -> Vec<usize> {
        let mut seen = Vec::new();
        self.see_into(visited, &mut seen, &mut Vec::new());
        seen
    }
}
