//! Predictions that are more accurate than the mean field of eqs. 2 and 3. A belief still consists of one distribution
//! per cell.
//!
//! Eq. 2 gives the weight of each next state `m` of a cell: `N[m] = b[m] + sum_k w[m, x_k, k]`. Here `b[m]` is a bias
//! and `x_k` is the state of neighbour `k`. Eq. 3 divides the weights by their total `D = sum_m N[m]`. The states of
//! the neighbours are uncertain, so the predictor is the mean `E[N[m] / D]`. The mean field makes two errors.
//!
//! **Ratio of means.** The mean field computes `E[N[m]] / E[D]` instead of `E[N[m] / D]`. The second-order
//! prediction writes `1 / D` as the integral of `exp(-t D)` over `t > 0`. The filter assumes that neighbours are
//! independent, so the mean under the integral is a product over them. For each neighbour `k`, let
//! - `d_k = sum_m w[m, x_k, k]`, the total of its weights,
//! - `f_k = E[exp(-t d_k)]`, and
//! - `g_k[m] = E[w[m, x_k, k] exp(-t d_k)]`.
//!
//! Then, with `b = sum_m b[m]`,
//!
//! `E[N[m] exp(-t D)] = exp(-t b) (prod_k f_k) (b[m] + sum_k g_k[m] / f_k)`.
//!
//! Gauss-Laguerre quadrature with two nodes `s`, at `t = s / E[D]`, approximates the integral. The result agrees with
//! the expansion of `1 / D` around `E[D]` to second order, and is never negative. If no `d_k` depends on the
//! neighbour's state, `D` is certain. The mean field is then exact, so it is computed instead of the integral.
//!
//! **Echo.** A cell changes its neighbours, and the changed beliefs about them change the cell's next prediction, as if
//! they were new evidence. Dynamic message passing (Karrer and Newman 2010; Lokhov et al. 2014) avoids this echo. It
//! keeps a *cavity* for each cell and each of its neighbours: the belief about the cell, given that the neighbour stays
//! susceptible. A cell is *susceptible* in the state in which its neighbours influence its next state. A susceptible
//! cell is predicted from its neighbours' cavities, which do not contain its own influence. Cavities need own-state
//! kernels: one kernel for each current state of the cell. If neighbours have an influence in several current states,
//! only the state with the most influence is treated as susceptible.

mod chunk;
mod kernels;
mod lanes;
mod layout;
mod padded;
mod planes;

pub use kernels::Weights;

use crate::estimation::belief::Belief;
use chunk::{ChunkInputs, ChunkPredictor};
use emberwatch_model::Shape;
use emberwatch_model::vectors::vectorised;
use lanes::{LANES, Lanes, add, add_product, lanes_from};
use layout::Layout;
use padded::PaddedBeliefs;

/// A method of prediction.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum PredictionKind {
    /// Eqs. 2 and 3, applied to the neighbours' mean weights.
    #[default]
    MeanField,
    /// The mean of the ratio in eq. 3, to second order.
    SecondOrder,
    /// The second-order prediction, computed from the neighbours' cavities.
    Cavities,
}

/// Maximum deviation from 1 of a distribution's sum that is left uncorrected.
const MAX_DRIFT: f32 = 1e-5;

/// Normalises distributions whose rounding errors have added up, as happens in a cell that is never seen.
///
/// The planes of two successive states start `plane_length` values apart, and each lane contains one distribution.
#[inline(always)]
fn correct_drift(planes: &mut [f32], plane_length: usize, sums: &[f32]) {
    if sums.iter().all(|sum| (sum - 1.0).abs() <= MAX_DRIFT) {
        return;
    }
    for plane in planes.chunks_mut(plane_length) {
        let lanes = plane.iter_mut().zip(sums);
        lanes.for_each(|(probability, sum)| *probability /= sum);
    }
}

/// The computation of one world's predictors, with the world's cavities.
#[derive(Debug, Clone)]
pub struct Prediction {
    shape: Shape,
    n_states: usize,
    kind: PredictionKind,
    layout: Layout,
    /// Index of the susceptible state's kernel, if there are cavities.
    susceptible: Option<usize>,
    /// For each neighbour, the offset from the cell's index in a plane to the neighbour's index.
    offsets: Vec<isize>,
    beliefs: PaddedBeliefs,
    /// Buffer for the cavities after the next prediction.
    next: PaddedBeliefs,
    /// For each neighbour, the index of its belief in the planes, for the current chunk and kernel.
    places: Vec<usize>,
    predictor: ChunkPredictor,
}

impl Prediction {
    /// Prepares predictions on the belief's grid. All cavities start as copies of the given belief.
    ///
    /// Without own-state kernels, [`PredictionKind::Cavities`] has no cavities and computes the second-order
    /// prediction.
    ///
    /// # Panics
    /// If the belief and the weights have different numbers of states.
    pub fn new(weights: Weights<'_>, kind: PredictionKind, belief: &Belief) -> Self {
        let (n_states, _, height, width) = weights.kernels[0].dim();
        assert_eq!(
            belief.n_states(),
            n_states,
            "belief: expected the weights' number of states"
        );
        let layout = Layout::new(weights);
        let wants_cavities = kind == PredictionKind::Cavities;
        let susceptible = wants_cavities.then(|| layout.most_influenced()).flatten();
        let n_neighbours = layout.taps.len();
        let n_cavities = susceptible.map_or(0, |_| n_neighbours);
        let beliefs = PaddedBeliefs::new(belief, [height, width], n_cavities, weights.edge);
        let offsets = layout.taps.iter().map(|tap| beliefs.planes.offset(*tap));
        Self {
            shape: belief.shape(),
            n_states,
            kind,
            susceptible,
            offsets: offsets.collect(),
            next: beliefs.clone(),
            beliefs,
            places: vec![0; n_neighbours],
            predictor: ChunkPredictor::new(&layout, n_states),
            layout,
        }
    }

    /// Returns the method of prediction.
    pub fn kind(&self) -> PredictionKind {
        self.kind
    }

    /// Returns the approximate memory use in bytes.
    pub fn memory_bytes(&self) -> usize {
        // The factor 2 accounts for a second set of beliefs, and for work space as large as the weights.
        let n_weights = self.n_states * self.n_states * (1 + self.offsets.len());
        let beliefs = size_of_val(&*self.beliefs.probabilities);
        2 * (beliefs + n_weights * size_of::<Lanes>()) + self.layout.slots.memory_bytes()
    }

    /// Returns whether there are cavities. If so, [`Self::correct`] must update them after each correction of the
    /// belief.
    pub fn has_cavities(&self) -> bool {
        self.susceptible.is_some()
    }

    /// Returns the number of bytes of [`Self::to_bytes`].
    pub fn n_bytes(&self) -> usize {
        self.beliefs.n_bytes()
    }

    /// Returns the cavities, each `[S, H, W]`, row-major, as little-endian `f32`. If there are no cavities, the result
    /// is empty.
    pub fn to_bytes(&self) -> Vec<u8> {
        self.beliefs.cavities_to_bytes()
    }

    /// Loads the cavities from the bytes of a prediction with the same weights, kind and grid.
    ///
    /// Returns false and changes nothing if the length differs, or if [`Belief::from_bytes`] rejects a cavity.
    pub fn restore(&mut self, bytes: &[u8]) -> bool {
        self.beliefs.restore_cavities(bytes)
    }

    /// Updates the cavities with a correction that changed the belief from `before` to `after`, both `[S, H, W]`.
    pub fn correct(&mut self, before: &[f32], after: &[f32]) {
        if self.has_cavities() {
            self.beliefs.correct_cavities(before, after);
        }
    }

    /// Computes the predictor from a posterior, both `[S, H, W]`, and predicts the cavities.
    ///
    /// # Panics
    /// If either slice has a different length.
    pub fn predict(&mut self, posterior: &[f32], predictor: &mut [f32]) {
        let expected = self.n_states * self.shape.n_cells();
        assert_eq!(posterior.len(), expected, "posterior: expected [S, H, W]");
        assert_eq!(predictor.len(), expected, "predictor: expected [S, H, W]");
        self.beliefs.set_belief(posterior);
        vectorised(
            #[inline(always)]
            || {
                let mut chunk = 0;
                for row in 0..self.shape.height() {
                    for col in (0..self.shape.width()).step_by(LANES) {
                        self.predict_chunk([row, col], chunk, predictor);
                        chunk += 1;
                    }
                }
            },
        );
        std::mem::swap(&mut self.beliefs, &mut self.next);
    }

    /// Predicts the cells of a chunk that starts at `[row, col]`, and their cavities.
    #[inline(always)] // So that `vectorised` compiles it for this processor's vector instructions.
    fn predict_chunk(&mut self, [row, col]: [usize; 2], chunk: usize, predictor: &mut [f32]) {
        let place = self.beliefs.planes.place([row, col]);
        self.predict_kernels(place, chunk);
        let slots = self.layout.slots.of_chunk(chunk);
        let n_lanes = LANES.min(self.shape.width() - col);
        let (n_cells, first) = (self.shape.n_cells(), row * self.shape.width() + col);
        let n_cavities = self.beliefs.n_cavities;
        let at = self.beliefs.start(n_cavities) + place;
        let mut sums = [0.0; LANES];
        for state in 0..self.n_states {
            let lanes = self.next_probability(state, slots, at, None);
            add(&mut sums, &lanes);
            predictor[state * n_cells + first..][..n_lanes].copy_from_slice(&lanes[..n_lanes]);
        }
        correct_drift(&mut predictor[first..], n_cells, &sums[..n_lanes]);
        let length = self.beliefs.planes.length;
        for cavity in 0..n_cavities {
            let at = self.beliefs.start(cavity) + place;
            let mut sums = [0.0; LANES];
            for state in 0..self.n_states {
                let lanes = self.next_probability(state, slots, at, Some(cavity));
                add(&mut sums, &lanes);
                let to = at + state * length;
                self.next.probabilities[to..][..n_lanes].copy_from_slice(&lanes[..n_lanes]);
            }
            let end = self.beliefs.start(cavity + 1);
            correct_drift(
                &mut self.next.probabilities[at..end],
                length,
                &sums[..n_lanes],
            );
        }
    }

    /// Computes the next-state distributions of all kernels for the chunk that starts at index `place` of a plane.
    #[inline(always)]
    fn predict_kernels(&mut self, place: usize, chunk: usize) {
        let n = self.offsets.len();
        for (index, kernel) in self.layout.kernels.iter().enumerate() {
            let has_cavities = self.susceptible == Some(index);
            let neighbours = self.places.iter_mut().zip(&self.offsets).enumerate();
            for (neighbour, (to, offset)) in neighbours {
                // Use the neighbour's cavity that excludes this cell's influence. As seen from the neighbour, this cell
                // lies in the opposite direction.
                let opposite = n - 1 - neighbour;
                let belief = if has_cavities {
                    opposite
                } else {
                    self.beliefs.n_cavities
                };
                *to = (self.beliefs.start(belief) + place).wrapping_add_signed(*offset);
            }
            let inputs = ChunkInputs {
                slots: self.layout.slots.of_chunk(chunk),
                planes: &self.beliefs.probabilities,
                plane_length: self.beliefs.planes.length,
                places: &self.places,
            };
            let is_second_order = self.kind != PredictionKind::MeanField;
            self.predictor
                .predict(index, kernel, is_second_order, has_cavities, inputs);
        }
    }

    /// Returns the probability of a next state, averaged over the cell's current states. The belief about the current
    /// state, which is a cavity if `cavity` is given, starts at index `at`.
    #[inline(always)]
    fn next_probability(
        &self,
        state: usize,
        slots: &[Lanes],
        at: usize,
        cavity: Option<usize>,
    ) -> Lanes {
        let length = self.beliefs.planes.length;
        let belief = |own: usize| lanes_from(&self.beliefs.probabilities, at + own * length);
        let mut sum = [0.0; LANES];
        for fixed in &self.layout.fixed {
            let probability = &slots[fixed.probability_slots[state]];
            add_product(&mut sum, belief(fixed.own_state), probability);
        }
        for (index, kernel) in self.layout.kernels.iter().enumerate() {
            let Some(next) = kernel.next_states.iter().position(|next| *next == state) else {
                continue;
            };
            let distribution = match cavity {
                Some(cavity) if self.susceptible == Some(index) => {
                    &self.predictor.cavity_distributions[cavity]
                }
                _ => &self.predictor.distributions[index],
            };
            match kernel.own_state {
                Some(own) => add_product(&mut sum, belief(own), &distribution[next]),
                None => sum = distribution[next],
            }
        }
        sum
    }
}

#[cfg(test)]
mod tests;
