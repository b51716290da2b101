//! Storage for the belief and the cavities of a prediction, in planes with margins.

use super::lanes::{LANES, Lanes, add_product, lanes_from};
use super::planes::Planes;
use crate::estimation::belief::Belief;
use emberwatch_model::Shape;
use emberwatch_model::vectors::vectorised;

/// Maximum factor by which a correction multiplies a probability. This limit keeps sums of products finite.
const MAX_FACTOR: f32 = 1e30;

/// Beliefs about one grid: a cavity per neighbour, if there are cavities, then the belief itself.
///
/// Each belief has one plane per state. The margins contain the belief about cells outside the grid: probability 1 for
/// the edge state, or zeros if there is none.
#[derive(Debug, Clone)]
pub struct PaddedBeliefs {
    shape: Shape,
    n_states: usize,
    pub n_cavities: usize,
    pub planes: Planes,
    pub probabilities: Vec<f32>,
}

impl PaddedBeliefs {
    /// Creates planes for a belief. Each cavity starts as a copy of the belief.
    ///
    /// `kernel` is the number of rows and columns of the transition kernel, which determine the margins.
    pub fn new(
        belief: &Belief,
        kernel: [usize; 2],
        n_cavities: usize,
        edge: Option<usize>,
    ) -> Self {
        let (shape, n_states) = (belief.shape(), belief.n_states());
        let planes = Planes::new(shape, kernel);
        let mut probabilities = vec![0.0; (1 + n_cavities) * n_states * planes.length];
        for of_belief in probabilities.chunks_exact_mut(n_states * planes.length) {
            if let Some(edge) = edge {
                of_belief[edge * planes.length..][..planes.length].fill(1.0);
            }
            planes.put(belief.as_slice(), of_belief);
        }
        Self {
            shape,
            n_states,
            n_cavities,
            planes,
            probabilities,
        }
    }

    /// Returns the index at which a cavity's first plane starts. The index `n_cavities` stands for the belief itself.
    #[inline(always)]
    pub fn start(&self, cavity: usize) -> usize {
        cavity * self.n_states * self.planes.length
    }

    /// Replaces the belief, but not the cavities.
    pub fn set_belief(&mut self, belief: &[f32]) {
        let start = self.start(self.n_cavities);
        self.planes.put(belief, &mut self.probabilities[start..]);
    }

    /// Returns the number of bytes of [`Self::cavities_to_bytes`].
    pub fn n_bytes(&self) -> usize {
        4 * self.n_cavities * self.n_states * self.shape.n_cells()
    }

    /// Returns the cavities, each `[S, H, W]`, row-major, as little-endian `f32`.
    pub fn cavities_to_bytes(&self) -> Vec<u8> {
        let cavities = &self.probabilities[..self.start(self.n_cavities)];
        let planes = cavities.chunks_exact(self.planes.length);
        let rows = planes.flat_map(|plane| self.planes.rows(plane));
        rows.flatten().flat_map(|p| p.to_le_bytes()).collect()
    }

    /// Loads the cavities from bytes. Returns false and changes nothing if the length differs, or if
    /// [`Belief::from_bytes`] rejects a cavity.
    pub fn restore_cavities(&mut self, bytes: &[u8]) -> bool {
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
        let n_probabilities = self.n_states * self.planes.length;
        let planes = self.probabilities.chunks_exact_mut(n_probabilities);
        for (planes, cavity) in planes.zip(&cavities) {
            self.planes.put(cavity.as_slice(), planes);
        }
        true
    }

    /// Multiplies cavities by the factors that turn `before` into `after`, both `[S, H, W]`, and normalises them.
    pub fn correct_cavities(&mut self, before: &[f32], after: &[f32]) {
        let mut factors = vec![[1.0; LANES]; self.n_states];
        vectorised(
            #[inline(always)]
            || {
                for row in 0..self.shape.height() {
                    for col in (0..self.shape.width()).step_by(LANES) {
                        self.correct_chunk([row, col], before, after, &mut factors);
                    }
                }
            },
        );
    }

    #[inline(always)]
    fn correct_chunk(
        &mut self,
        [row, col]: [usize; 2],
        before: &[f32],
        after: &[f32],
        factors: &mut [Lanes],
    ) {
        let first = row * self.shape.width() + col;
        let n_lanes = LANES.min(self.shape.width() - col);
        let [before, after] = [before, after].map(|belief| &belief[first..]);
        let n_cells = self.shape.n_cells();
        let is_changed = correction_factors(before, after, n_cells, &mut factors[..], n_lanes);
        if !is_changed.contains(&true) {
            return;
        }
        for cavity in 0..self.n_cavities {
            let at = self.start(cavity) + self.planes.place([row, col]);
            let mut total = [0.0; LANES];
            for (state, factor) in factors.iter().enumerate() {
                let cavity = lanes_from(&self.probabilities, at + state * self.planes.length);
                add_product(&mut total, cavity, factor);
            }
            for (state, factor) in factors.iter().enumerate() {
                let at = at + state * self.planes.length;
                let cavity = &mut self.probabilities[at..][..n_lanes];
                for (lane, p) in cavity.iter_mut().enumerate() {
                    if is_changed[lane] && total[lane] > 0.0 {
                        *p = *p * factor[lane] / total[lane];
                    }
                }
            }
        }
    }
}

/// Returns whether each cell's belief has changed.
#[inline(always)]
fn correction_factors(
    before: &[f32],
    after: &[f32],
    n_cells: usize,
    factors: &mut [Lanes],
    n_lanes: usize,
) -> [bool; LANES] {
    let mut is_changed = [false; LANES];
    for (state, factor) in factors.iter_mut().enumerate() {
        *factor = [1.0; LANES];
        let at = state * n_cells;
        for lane in 0..n_lanes {
            let (before, after) = (before[at + lane], after[at + lane]);
            is_changed[lane] |= after != before;
            if after != before && before > 0.0 {
                factor[lane] = (after / before).min(MAX_FACTOR);
            }
        }
    }
    is_changed
}
