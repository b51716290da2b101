//! A memory layout with one plane per state. Margins of zeros allow kernels to treat cells at the border like all other
//! cells.

use emberwatch_model::Shape;

/// Number of cells in the widest SIMD vector, which is a multiple of every processor's vector length.
pub(crate) const LANES: usize = 16;

/// The layout of planes whose margins are half a kernel wide. Rows are padded to a multiple of [`LANES`], plus
/// [`LANES`] further columns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Layout {
    pub(crate) shape: Shape,
    pub(crate) n_states: usize,
    pub(crate) kernel_height: usize,
    pub(crate) kernel_width: usize,
    pub(crate) above: usize,
    pub(crate) left: usize,
    pub(crate) stride: usize,
    pub(crate) plane: usize,
}

impl Layout {
    pub(crate) fn new(shape: Shape, n_states: usize, kernel: (usize, usize)) -> Self {
        let (kernel_height, kernel_width) = kernel;
        // Kernels are at most 15 wide (`MAX_KERNEL_SIDE`), so that one further vector is enough.
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

    pub(crate) fn n_taps(&self) -> usize {
        self.kernel_height * self.kernel_width
    }

    pub(crate) fn planes(&self) -> Vec<f32> {
        vec![0.0; self.n_states * self.plane]
    }

    /// Returns the number of computed columns, a multiple of the vector length.
    pub(crate) fn columns(&self) -> usize {
        self.shape.width().next_multiple_of(LANES)
    }

    pub(crate) fn row(&self, row: usize) -> usize {
        (row + self.above) * self.stride + self.left
    }

    pub(crate) fn place(&self, cell: usize) -> usize {
        self.row(cell / self.shape.width()) + cell % self.shape.width()
    }

    pub(crate) fn mask(&self) -> Vec<f32> {
        let on_grid = |col| f32::from(u8::from(col < self.shape.width()));
        (0..self.columns()).map(on_grid).collect()
    }

    pub(crate) fn load(&self, from: &[f32], to: &mut [f32]) {
        let states = from.chunks_exact(self.shape.n_cells());
        for (cells, plane) in states.zip(to.chunks_exact_mut(self.plane)) {
            for (row, cells) in cells.chunks_exact(self.shape.width()).enumerate() {
                plane[self.row(row)..][..cells.len()].copy_from_slice(cells);
            }
        }
    }

    pub(crate) fn unload(&self, from: &[f32], to: &mut [f32]) {
        let states = to.chunks_exact_mut(self.shape.n_cells());
        for (cells, plane) in states.zip(from.chunks_exact(self.plane)) {
            for (row, cells) in cells.chunks_exact_mut(self.shape.width()).enumerate() {
                cells.copy_from_slice(&plane[self.row(row)..][..cells.len()]);
            }
        }
    }
}
