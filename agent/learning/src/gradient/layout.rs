//! Where a cell of a state lies in planes with a margin of zeros, so that no cell is special.

use emberwatch_model::Shape;

/// Cells that the widest vectors hold; those of each kind of processor divide it.
pub(super) const LANES: usize = 16;

/// Half a kernel of margin on each side, and on the right up to whole [`LANES`] and one more.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Layout {
    pub(super) shape: Shape,
    pub(super) n_states: usize,
    pub(super) kernel_height: usize,
    pub(super) kernel_width: usize,
    /// Rows of margin above the grid.
    pub(super) above: usize,
    /// Columns of margin on its left.
    pub(super) left: usize,
    /// Places from one row to the next.
    pub(super) stride: usize,
    /// Places from one state to the next.
    pub(super) plane: usize,
}

impl Layout {
    pub(super) fn new(shape: Shape, n_states: usize, kernel: (usize, usize)) -> Self {
        let (kernel_height, kernel_width) = kernel;
        // A model's kernels are at most 15 wide (`MAX_KERNEL_SIDE`): one more vector is room enough.
        let stride = shape.width().next_multiple_of(LANES) + LANES;
        Self {
            shape,
            n_states,
            kernel_height,
            kernel_width,
            above: kernel_height / 2,
            left: kernel_width / 2,
            stride,
            plane: (shape.height() + kernel_height - 1) * stride,
        }
    }

    /// Taps of the kernel between two states.
    pub(super) fn n_taps(&self) -> usize {
        self.kernel_height * self.kernel_width
    }

    /// Planes of zeros, one per state.
    pub(super) fn planes(&self) -> Vec<f32> {
        vec![0.0; self.n_states * self.plane]
    }

    /// Columns that are computed: whole vectors.
    pub(super) fn columns(&self) -> usize {
        self.shape.width().next_multiple_of(LANES)
    }

    /// Place of the first cell of a row, in the first state's plane.
    pub(super) fn row(&self, row: usize) -> usize {
        (row + self.above) * self.stride + self.left
    }

    /// Place of a cell, in the first state's plane.
    pub(super) fn place(&self, cell: usize) -> usize {
        self.row(cell / self.shape.width()) + cell % self.shape.width()
    }

    /// 1 for each column of the grid, 0 for those up to whole vectors.
    pub(super) fn mask(&self) -> Vec<f32> {
        let on_grid = |col| f32::from(u8::from(col < self.shape.width()));
        (0..self.columns()).map(on_grid).collect()
    }

    /// Copies beliefs `[S, H, W]` inside the margins.
    pub(super) fn load(&self, from: &[f32], to: &mut [f32]) {
        let states = from.chunks_exact(self.shape.n_cells());
        for (cells, plane) in states.zip(to.chunks_exact_mut(self.plane)) {
            for (row, cells) in cells.chunks_exact(self.shape.width()).enumerate() {
                plane[self.row(row)..][..cells.len()].copy_from_slice(cells);
            }
        }
    }

    /// The reverse of [`Self::load`].
    pub(super) fn unload(&self, from: &[f32], to: &mut [f32]) {
        let states = to.chunks_exact_mut(self.shape.n_cells());
        for (cells, plane) in states.zip(from.chunks_exact(self.plane)) {
            for (row, cells) in cells.chunks_exact_mut(self.shape.width()).enumerate() {
                cells.copy_from_slice(&plane[self.row(row)..][..cells.len()]);
            }
        }
    }
}
