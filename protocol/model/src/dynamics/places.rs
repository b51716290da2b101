//! The buffers of [`super::Dynamics`]: states with a margin around the grid, so that cells at the edge need no special
//! treatment.
//!
//! A *place* is an index in the buffer of states. Every cell has a place, and so has every position in a margin of half
//! a kernel around the grid. A cell's *home* is the place of the neighbour at the upper left of its kernel, so every
//! neighbour lies at a fixed offset from the home.

use super::super::grid::Shape;
use super::super::parameters::Model;
use super::lanes::LANES;

/// The value of places outside the grid that have no influence.
pub(super) const OFF_GRID: u8 = 255;

#[derive(Debug, Clone)]
pub(super) struct Places {
    width: usize,
    pub(super) stride: usize,
    margins: [usize; 2],
    /// `X_k`. The margin contains the model's edge state, or [`OFF_GRID`].
    pub(super) states: Vec<u8>,
    /// Indexed by home. During a step it contains first random bytes, then next states and the marks of undecided
    /// cells, and finally `X_{k+1}`.
    pub(super) next: Vec<u8>,
}

impl Places {
    pub(super) fn new(model: &Model, shape: Shape) -> Self {
        let [kernel_height, kernel_width] = model.kernel_size();
        let (n_places, n_homes) = Self::lengths(model, shape);
        Self {
            width: shape.width(),
            stride: shape.width() + kernel_width - 1,
            margins: [kernel_height / 2, kernel_width / 2],
            states: vec![model.edge().map_or(OFF_GRID, |edge| edge as u8); n_places],
            next: vec![0; n_homes],
        }
    }

    pub(super) fn lengths(model: &Model, shape: Shape) -> (usize, usize) {
        let [kernel_height, kernel_width] = model.kernel_size();
        let stride = shape.width() + kernel_width - 1;
        let n_homes = (shape.height() * stride).next_multiple_of(LANES);
        let n_places = n_homes + (kernel_height - 1) * stride + kernel_width - 1;
        (n_places, n_homes)
    }

    pub(super) fn home(&self, row: usize, col: usize) -> usize {
        row * self.stride + col
    }

    pub(super) fn centre(&self) -> usize {
        let [above, left] = self.margins;
        above * self.stride + left
    }

    #[inline(always)]
    pub(super) fn load(&mut self, cells: &[u8]) {
        let ([above, left], width) = (self.margins, self.width);
        let rows = self.states.chunks_exact_mut(self.stride).skip(above);
        for (from, to) in cells.chunks_exact(width).zip(rows) {
            to[left..left + width].copy_from_slice(from);
        }
    }

    #[inline(always)]
    pub(super) fn store(&self, cells: &mut [u8]) {
        let rows = self.next.chunks(self.stride);
        for (to, from) in cells.chunks_exact_mut(self.width).zip(rows) {
            to.copy_from_slice(&from[..self.width]);
        }
    }
}
