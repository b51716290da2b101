//! The cavities of a [`Prediction`] between predictions: corrected, saved and restored.

use super::Prediction;
use super::lanes::{LANES, add_product, lanes_from};
use crate::estimation::belief::Belief;
use emberwatch_model::vectors::vectorised;

/// A correction multiplies no belief by more.
const MOST: f32 = 1e30;

impl Prediction {
    /// Whether corrections of the belief must be told, see [`Self::correct`].
    pub fn has_cavities(&self) -> bool {
        self.held.is_some()
    }

    /// Returns the number of bytes of [`Self::to_bytes`].
    pub fn n_bytes(&self) -> usize {
        4 * self.n_cavities() * self.n_states * self.shape.n_cells()
    }

    /// Returns the cavities, which the belief does not contain: each `[S, H, W]`, row-major, as little-endian `f32`.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(self.n_bytes());
        let cavities = &self.beliefs[..self.start_of_belief()];
        for plane in cavities.chunks_exact(self.planes.length) {
            for row in 0..self.shape.height() {
                let cells = &plane[self.planes.place([row, 0])..][..self.shape.width()];
                bytes.extend(cells.iter().flat_map(|p| p.to_le_bytes()));
            }
        }
        bytes
    }

    /// Loads the cavities from the bytes of a prediction with the same weights, kind and grid.
    ///
    /// Returns false and changes nothing if the length differs or a cavity is no belief, see [`Belief::from_bytes`].
    pub fn restore(&mut self, bytes: &[u8]) -> bool {
        if bytes.len() != self.n_bytes() {
            return false;
        }
        let (height, width) = self.shape.dim();
        let dim = (self.n_states, height, width);
        let cavities = bytes.chunks_exact(4 * self.n_states * self.shape.n_cells());
        let cavities: Option<Vec<_>> = cavities.map(|it| Belief::from_bytes(it, dim)).collect();
        let Some(cavities) = cavities else {
            return false;
        };
        let planes = self
            .beliefs
            .chunks_exact_mut(self.n_states * self.planes.length);
        for (to, cavity) in planes.zip(&cavities) {
            self.planes.put(self.shape, cavity.as_slice(), to);
        }
        true
    }

    /// What has changed a belief from `before` to `after`, both `[S, H, W]`, changes its cavities by the same factors.
    pub fn correct(&mut self, before: &[f32], after: &[f32]) {
        if !self.has_cavities() {
            return;
        }
        vectorised(
            #[inline(always)]
            || {
                for row in 0..self.shape.height() {
                    for col in (0..self.shape.width()).step_by(LANES) {
                        self.correct_cells([row, col], before, after);
                    }
                }
            },
        );
    }

    #[inline(always)]
    fn correct_cells(&mut self, [row, col]: [usize; 2], before: &[f32], after: &[f32]) {
        let (n_cells, first) = (self.shape.n_cells(), row * self.shape.width() + col);
        let n_lanes = LANES.min(self.shape.width() - col);
        let mut is_changed = [false; LANES];
        for (state, factor) in self.factors.iter_mut().enumerate() {
            *factor = [1.0; LANES];
            let at = state * n_cells + first;
            for lane in 0..n_lanes {
                let (before, after) = (before[at + lane], after[at + lane]);
                is_changed[lane] |= after != before;
                if after != before && before > 0.0 {
                    factor[lane] = (after / before).min(MOST);
                }
            }
        }
        if !is_changed.contains(&true) {
            return;
        }
        let place = self.planes.place([row, col]);
        let n_of_cavity = self.n_states * self.planes.length;
        for cavity in 0..self.offsets.len() {
            let at = cavity * n_of_cavity + place;
            let mut total = [0.0; LANES];
            for (state, factor) in self.factors.iter().enumerate() {
                let belief = lanes_from(&self.beliefs, at + state * self.planes.length);
                add_product(&mut total, belief, factor);
            }
            for (state, factor) in self.factors.iter().enumerate() {
                let beliefs = &mut self.beliefs[at + state * self.planes.length..][..n_lanes];
                for (lane, belief) in beliefs.iter_mut().enumerate() {
                    if is_changed[lane] && total[lane] > 0.0 {
                        *belief *= factor[lane] / total[lane];
                    }
                }
            }
        }
    }
}
