//! An [`Airspace`]: where the robots of a grid may fly, and which cells they see from a path.

use super::file::Pays;
use super::grid::{Cell, Grid, Shape};
use super::path::{Flight, Move, fly_by};
use std::sync::Arc;

/// Where robots may fly, and what their sensor sees from there.
#[derive(Debug, Clone, PartialEq)]
pub struct Airspace {
    shape: Shape,
    /// Where no robot may be.
    no_fly: Option<Arc<Grid<bool>>>,
    radius: usize,
    n_rings: usize,
    pays: Pays,
}

/// A cell that is seen from a path.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SeenCell {
    /// Its row-major index.
    pub cell: usize,
    /// The observation matrix that it is seen by: the best of all from the path.
    pub ring: u8,
}

impl Airspace {
    /// All of a grid, with a sensor that sees the cells of the path.
    pub fn open(shape: Shape) -> Self {
        Self::new(shape, None, 0, 1, Pays::Visited)
    }

    /// A grid without the cells of `no_fly` (shape `[H, W]`), whose sensor sees `radius` rows and columns beyond each
    /// cell of the path by `n_rings` observation matrices. With a radius of 0, what is seen is what is visited.
    ///
    /// # Panics
    /// If the map is of another grid.
    pub fn new(
        shape: Shape,
        no_fly: Option<Arc<Grid<bool>>>,
        radius: usize,
        n_rings: usize,
        pays: Pays,
    ) -> Self {
        let dim = no_fly.as_ref().map_or(shape.dim(), |map| map.dim());
        assert_eq!(dim, shape.dim(), "no_fly: expected the grid");
        Self {
            shape,
            no_fly: no_fly.filter(|map| map.iter().any(|closed| *closed)),
            radius,
            n_rings,
            pays: if radius == 0 { Pays::Visited } else { pays },
        }
    }

    /// The grid.
    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// Rows and columns that the sensor sees beyond each cell of the path, 0 to 8.
    pub fn radius(&self) -> usize {
        self.radius
    }

    /// Observation matrices: of the path, then of the rings around it.
    pub fn n_rings(&self) -> usize {
        self.n_rings
    }

    /// Which distinct cells pay.
    pub fn pays(&self) -> Pays {
        self.pays
    }

    /// Whether all of the grid may be flown over.
    pub fn is_open(&self) -> bool {
        self.no_fly.is_none()
    }

    /// Where no robot may be, shape `[H, W]`, if there is such a cell.
    pub fn no_fly(&self) -> Option<&Arc<Grid<bool>>> {
        self.no_fly.as_ref()
    }

    /// Whether a robot may be at a cell of the grid.
    #[inline]
    pub fn is_free(&self, cell: Cell) -> bool {
        !self
            .no_fly
            .as_ref()
            .is_some_and(|map| map[[cell.row, cell.col]])
    }

    /// The cell that a move leads to; one off the grid or into a no-fly cell leaves the robot in place.
    #[inline]
    pub fn after(&self, step: Move, cell: Cell) -> Cell {
        let next = step.apply(cell, self.shape);
        if self.is_free(next) { next } else { cell }
    }

    /// A move, or the next in [`Move::ALL`] if it leads into a no-fly cell: one that a planner may plan.
    #[inline]
    pub fn around(&self, step: Move, cell: Cell) -> Move {
        let may_be = |step: &Move| self.is_free(step.apply(cell, self.shape));
        let mut steps = (0..4).map(|turn| Move::from_low_bits(step as u64 + turn));
        steps.find(may_be).unwrap_or(step)
    }

    /// Replaces the moves of a path that lead into no-fly cells, as [`Self::around`].
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

    /// Flies a path from `start` (paper eq. 12, `z_{t+1} = z_t + v_t`, unless that is off the grid or a no-fly cell).
    pub fn fly(&self, start: Cell, path: &[Move]) -> Flight {
        let mut visited = Vec::new();
        let end = self.fly_into(start, path, &mut visited, &mut Vec::new());
        Flight { visited, end }
    }

    /// [`Self::fly`] without new memory: the visited cells go to `visited`; `seen` is scratch of any content. Returns
    /// the robot's last cell.
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

    /// Lists the cells in sight of visited ones (row-major indices), each once; `rings` is scratch of any content.
    pub fn see_into(&self, visited: &[usize], seen: &mut Vec<SeenCell>, rings: &mut Vec<u8>) {
        const UNSEEN: u8 = u8::MAX;
        seen.clear();
        if self.radius == 0 {
            seen.extend(visited.iter().map(|&cell| SeenCell { cell, ring: 0 }));
            return;
        }
        rings.clear();
        rings.resize(self.shape.n_cells(), UNSEEN);
        let last = (self.n_rings - 1) as u8;
        let (height, width) = self.shape.dim();
        let within = |at: usize, side: usize| {
            at.saturating_sub(self.radius)..(at + self.radius + 1).min(side)
        };
        for &index in visited {
            let Cell { row, col } = self.shape.cell(index);
            for near_row in within(row, height) {
                let down = near_row.abs_diff(row);
                for near_col in within(col, width) {
                    let ring = (down.max(near_col.abs_diff(col)) as u8).min(last);
                    let cell = near_row * width + near_col;
                    if rings[cell] == UNSEEN {
                        seen.push(SeenCell { cell, ring });
                    }
                    rings[cell] = rings[cell].min(ring);
                }
            }
        }
        seen.iter_mut().for_each(|it| it.ring = rings[it.cell]);
    }

    /// The distinct cells that pay on a path, by row-major index.
    pub fn paying(&self, start: Cell, path: &[Move]) -> Vec<usize> {
        let visited = self.fly(start, path).visited;
        match self.pays {
            Pays::Visited => visited,
            Pays::Seen => self.see(&visited).iter().map(|it| it.cell).collect(),
        }
    }

    /// [`Self::see_into`] with new memory.
    pub fn see(&self, visited: &[usize]) -> Vec<SeenCell> {
        let mut seen = Vec::new();
        self.see_into(visited, &mut seen, &mut Vec::new());
        seen
    }
}
