//! Planes with margins around a grid, so that cells at the edge have all their neighbours too.

use super::lanes::LANES;
use emberwatch_model::Shape;

/// The memory layout of a plane: the grid with margins on all sides, row-major.
#[derive(Debug, Clone, Copy)]
pub struct Planes {
    shape: Shape,
    /// Number of rows above and below the grid, and of columns to its left and right.
    margin: [usize; 2],
    stride: usize,
    /// Number of cells of a plane, with margins.
    pub length: usize,
}

impl Planes {
    /// Lays out planes whose margins are half as wide as the kernel.
    pub fn new(shape: Shape, kernel: [usize; 2]) -> Self {
        let margin = kernel.map(|side| side / 2);
        let stride = shape.width().next_multiple_of(LANES) + 2 * margin[1];
        Self {
            shape,
            margin,
            stride,
            length: (shape.height() + 2 * margin[0]) * stride,
        }
    }

    /// Returns the index of a cell in its plane.
    pub fn place(&self, [row, col]: [usize; 2]) -> usize {
        (row + self.margin[0]) * self.stride + col + self.margin[1]
    }

    /// Returns the offset from a cell's index to that of the neighbour at this relative row and column.
    pub fn offset(&self, [row, col]: [isize; 2]) -> isize {
        row * self.stride as isize + col
    }

    /// Copies a belief, shape `[S, H, W]`, into the planes of its S states. Margins keep their values.
    pub fn put(&self, belief: &[f32], planes: &mut [f32]) {
        let width = self.shape.width();
        let states = belief.chunks_exact(self.shape.n_cells());
        for (cells, plane) in states.zip(planes.chunks_exact_mut(self.length)) {
            for (row, cells) in cells.chunks_exact(width).enumerate() {
                plane[self.place([row, 0])..][..width].copy_from_slice(cells);
            }
        }
    }

    /// Returns the rows of a plane without the margins.
    pub fn rows<'a>(&self, plane: &'a [f32]) -> impl Iterator<Item = &'a [f32]> + use<'a> {
        let Self { shape, .. } = *self;
        let rows = plane[self.place([0, 0])..].chunks(self.stride);
        rows.take(shape.height())
            .map(move |row| &row[..shape.width()])
    }
}
