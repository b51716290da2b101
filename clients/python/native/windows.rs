//! Squares of cells around robots, for the observation parts `local` and `recent`.

use emberwatch_model::{Airspace, Cell, Shape};
use numpy::ndarray::ArrayView3;

/// Number of channels about the path: cells that this path has visited, cells off the grid or no-fly, and the remaining
/// share of the path. They come after the channels about the world.
pub const N_OF_PATH: usize = 3;

/// A map of each robot's world, with a margin around the grid, so that every window lies within the map.
pub struct Windows {
    shape: Shape,
    side: usize,
    n_channels: usize,
    maps: Vec<u8>,
}

impl Windows {
    pub fn new(n_rows: usize, airspace: &Airspace, side: usize, n_of_world: usize) -> Self {
        let shape = airspace.shape();
        let mut windows = Self {
            shape,
            side,
            n_channels: n_of_world + N_OF_PATH,
            maps: vec![0; Self::n_bytes(n_rows, shape, side, n_of_world)],
        };
        windows.mark_off(n_rows, airspace);
        windows
    }

    pub fn n_bytes(n_rows: usize, shape: Shape, side: usize, n_of_world: usize) -> usize {
        let (height, width) = shape.dim();
        let n_cells = (height + side - 1).saturating_mul(width + side - 1);
        n_rows
            .saturating_mul(n_cells)
            .saturating_mul(n_of_world + N_OF_PATH)
    }

    pub fn dim(&self) -> (usize, usize) {
        (self.side, self.n_channels - N_OF_PATH)
    }

    /// Begins a robot's path: sets the channels about the world to `shown`, `[H, W, channels]`, and clears the visited
    /// cells.
    pub fn show(&mut self, row: usize, shown: ArrayView3<'_, u8>) {
        let (_, n_of_world) = self.dim();
        for (y, shown) in shown.outer_iter().enumerate() {
            let first = self.index(row, Cell { row: y, col: 0 });
            let cells = self.maps[first..].chunks_exact_mut(self.n_channels);
            for (cell, shown) in cells.zip(shown.outer_iter()) {
                (cell.iter_mut().zip(shown)).for_each(|(to, &value)| *to = value);
                cell[n_of_world] = 0;
            }
        }
    }

    /// Marks a cell as visited, and clears its channels about the world, because no reward remains there.
    pub fn visit(&mut self, row: usize, cell: Cell) {
        let (first, (_, n_of_world)) = (self.index(row, cell), self.dim());
        self.maps[first..][..n_of_world].fill(0);
        self.maps[first + n_of_world] = 255;
    }

    /// Appends the window around a robot, `[side, side, channels]`, to `out`. `left` is the remaining share of its path.
    pub fn append(&self, row: usize, robot: Cell, left: u8, out: &mut Vec<u8>) {
        let begin = out.len();
        for y in 0..self.side {
            let first = self.padded(row, robot.row + y, robot.col);
            out.extend_from_slice(&self.maps[first..][..self.side * self.n_channels]);
        }
        let left_channel = out[begin..].iter_mut().skip(self.n_channels - 1);
        left_channel
            .step_by(self.n_channels)
            .for_each(|to| *to = left);
    }

    /// Sets the channel of forbidden cells: 255 in the margin and in no-fly cells, 0 elsewhere.
    fn mark_off(&mut self, n_rows: usize, airspace: &Airspace) {
        let off = self.n_channels - 2;
        let cells = self.maps.iter_mut().skip(off).step_by(self.n_channels);
        cells.for_each(|to| *to = 255);
        for row in 0..n_rows {
            for index in 0..self.shape.n_cells() {
                let cell = self.shape.cell(index);
                let at = self.index(row, cell) + off;
                self.maps[at] = if airspace.is_free(cell) { 0 } else { 255 };
            }
        }
    }

    fn index(&self, row: usize, cell: Cell) -> usize {
        let margin = self.side / 2;
        self.padded(row, cell.row + margin, cell.col + margin)
    }

    /// Returns a cell's index in the maps. `y` and `x` count from the corner of the margin.
    fn padded(&self, row: usize, y: usize, x: usize) -> usize {
        let (height, width) = self.shape.dim();
        let (height, width) = (height + self.side - 1, width + self.side - 1);
        ((row * height + y) * width + x) * self.n_channels
    }
}
