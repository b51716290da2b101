//! The buffers of [`super::Dynamics`]: states with a margin around the grid, so that cells at the edge need no special
//! treatment.
//!
//! A *place* is an index in the buffer of states. Every cell has a place, and so has every position in a margin of half
//! a kernel around the grid. A cell's *home* is the place of the neighbour at the upper left of its kernel, so every
//! neighbour lies at a fixed offset from the home.

use super::super::grid::Shape;
use super::super::parameters::Model;
use super::lanes::LANES;

/// The value of places outside the grid that add no weight.
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
        let (_, _, kernel_height, kernel_width) = model.kernel().dim();
        let (n_places, n_homes) = Self::lengths(model, shape);
        Self {
            width: shape.width(),
            stride: shape.width() + kernel_width - 1,
            margins: [kernel_height / 2, kernel_width / 2],
            states: vec![model.edge().map_or(OFF_GRID, |edge| edge as u8); n_places],
            next: vec![0; n_homes],
        }
    }

    /// Returns the number of places and the number of homes.
    pub(super) fn lengths(model: &Model, shape: Shape) -> (usize, usize) {
        let (_, _, kernel_height, kernel_width) = model.kernel().dim();
        let stride = shape.width() + kernel_width - 1;
        let n_homes = (shape.height() * stride).next_multiple_of(LANES);
        let n_places = n_homes + (kernel_height - 1) * stride + kernel_width - 1;
        (n_places, n_homes)
    }

    /// Returns, for each tap of a model's kernel, the offset of the neighbour's place from the cell's home.
    pub(super) fn offsets(&self, model: &Model) -> Vec<usize> {
        let (_, _, kernel_height, kernel_width) = model.kernel().dim();
        let taps = ndarray::indices((kernel_height, kernel_width)).into_iter();
        taps.map(|(row, col)| row * self.stride + col).collect()
    }

    /// Returns the zone of each cell, indexed by home, if the model has several zones. Homes that belong to no cell
    /// have zone 0.
    pub(super) fn zones(&self, model: &Model) -> Option<Vec<u8>> {
        let map = model.zone_map().filter(|_| model.n_zones() > 1)?;
        let mut zones = vec![0; self.next.len()];
        for (row, to) in map.rows().into_iter().zip(zones.chunks_mut(self.stride)) {
            to[..self.width].copy_from_slice(&row.to_vec());
        }
        Some(zones)
    }

    /// Copies the states of the grid's cells into the places between the margins.
    #[inline(always)]
    pub(super) fn load(&mut self, cells: &[u8]) {
        let ([above, left], width) = (self.margins, self.width);
        let rows = self.states.chunks_exact_mut(self.stride).skip(above);
        for (from, to) in cells.chunks_exact(width).zip(rows) {
            to[left..left + width].copy_from_slice(from);
        }
    }

    /// Copies the next states to the grid's cells.
    #[inline(always)]
    pub(super) fn store(&self, cells: &mut [u8]) {
        let rows = self.next.chunks(self.stride);
        for (to, from) in cells.chunks_exact_mut(self.width).zip(rows) {
            to.copy_from_slice(&from[..self.width]);
        }
    }
}

/// Returns the offset of a cell from its home.
pub(super) fn centre(offsets: &[usize]) -> usize {
    offsets[offsets.len() / 2]
}
