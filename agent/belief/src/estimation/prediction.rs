//! Predictors that are more accurate than the mean field of eqs. 2 and 3, for the same beliefs of a cell and its neighbours.
//!
//! The weights of a cell's next states are sums over its neighbours, `N[m] = b[m] + sum_k w[m, x_k, k]`, and eq. 3 divides
//! them by their total, `D = sum_m N[m]`. With uncertain neighbours two things go wrong.
//!
//! **Ratio of means.** The mean field takes `E[N] / E[D]` for `E[N / D]`. As `1 / D` is the integral of `exp(-t D)` over
//! `t > 0`, and neighbours are independent in the belief, `E[N[m] / D]` is that of
//! `exp(-t b) prod_k f_k (b[m] + sum_k g_k[m] / f_k)`, where `f_k` is the mean of `exp(-t d)` and `g_k[m]` that of
//! `w[m] exp(-t d)` over what neighbour `k` can be, with the total `d` of its weights. Gauss and Laguerre's rule with two
//! nodes at `t = s / E[D]` has the second order of the expansion around `E[D]`, and cannot become negative. Where each neighbour's
//! weights have the same total in all of its states, the mean field is exact, and is what is computed.
//!
//! **Echo.** What a cell did to its neighbour comes back from it as if it were news. Dynamic message passing (Karrer and Newman
//! 2010; Lokhov et al. 2014) keeps, of each cell and each neighbour, a belief of the cell while that neighbour is held in
//! the state in which its own neighbours act on it, the *cavity*: the neighbour is predicted from these, and so never
//! from itself. It needs kernels that see the cell's own state, in one of which alone neighbours act.

mod acts;
mod cells;
mod lanes;

pub use acts::Weights;

use crate::estimation::belief::Belief;
use acts::Layout;
use cells::{Reading, Work};
use emberwatch_model::Shape;
use emberwatch_model::vectors::vectorised;
use lanes::{LANES, Lanes, Planes, add_product, lanes_from};
use serde::{Deserialize, Serialize};

/// A correction multiplies no belief by more.
const MOST: f32 = 1e30;

/// How a predictor is computed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PredictionKind {
    /// Eqs. 2 and 3, of the mean of what neighbours are.
    #[default]
    MeanField,
    /// The mean of the ratio of eq. 3, to the second order.
    SecondOrder,
    /// The same from the cavities of neighbours.
    Cavities,
}

/// The predictor of one world, and its cavities.
#[derive(Debug, Clone)]
pub struct Prediction {
    shape: Shape,
    n_states: usize,
    kind: PredictionKind,
    layout: Layout,
    /// The act from whose cavities neighbours are predicted.
    held: Option<usize>,
    /// From a cell's place to those of its neighbours.
    offsets: Vec<isize>,
    planes: Planes,
    /// Beliefs with margins of zeros, or of ones in the planes of the edge's state; all states of one after the other: of each neighbour the cavity in which it is held,
    /// if there are any, then the belief itself.
    beliefs: Vec<f32>,
    next: Vec<f32>,
    /// Of each neighbour where its belief is read.
    places: Vec<usize>,
    work: Work,
    /// What a correction multiplies the beliefs of each state by.
    factors: Vec<Lanes>,
}

impl Prediction {
    /// The prediction of a grid's cells by some weights, with a first belief.
    ///
    /// Without own kernels there are no cavities: the second order alone is computed. Where neighbours act on several own
    /// states, cavities hold a cell in the one on which they act most.
    ///
    /// # Panics
    /// If the belief has other states than the weights.
    pub fn new(weights: Weights<'_>, kind: PredictionKind, belief: &Belief) -> Self {
        let (n_states, _, height, width) = weights.kernels[0].dim();
        assert_eq!(belief.n_states(), n_states, "belief: expected other states");
        let shape = belief.shape();
        let planes = Planes::new(shape, [height, width]);
        let layout = Layout::new(weights, shape);
        let is_held = kind == PredictionKind::Cavities;
        let held = is_held.then(|| layout.most_influenced()).flatten();
        let n_neighbours = layout.taps.len();
        let n_beliefs = 1 + held.map_or(0, |_| n_neighbours);
        let mut beliefs = vec![0.0; n_beliefs * n_states * planes.length];
        if let Some(edge) = weights.edge {
            let of_edge = beliefs.chunks_exact_mut(planes.length).skip(edge);
            of_edge.step_by(n_states).for_each(|plane| plane.fill(1.0));
        }
        let mut prediction = Self {
            shape,
            n_states,
            kind,
            held,
            offsets: layout.taps.iter().map(|tap| planes.offset(*tap)).collect(),
            planes,
            next: beliefs.clone(),
            beliefs,
            places: vec![0; n_neighbours],
            work: Work::new(&layout, n_states),
            factors: vec![[1.0; LANES]; n_states],
            layout,
        };
        prediction.begin(belief);
        prediction
    }

    /// Begins with a belief: all cavities have it.
    pub fn begin(&mut self, belief: &Belief) {
        let states = belief.as_slice().chunks_exact(self.shape.n_cells());
        let planes = self.beliefs.chunks_exact_mut(self.planes.length);
        for (to, from) in planes.zip(states.cycle()) {
            self.planes.put(self.shape, from, to);
        }
    }

    pub fn kind(&self) -> PredictionKind {
        self.kind
    }

    /// Returns about how many bytes of memory it takes.
    pub fn memory_bytes(&self) -> usize {
        // Weights, and as much work space.
        let n_weights = self.n_states * self.n_states * (1 + self.offsets.len());
        2 * (size_of_val(&*self.beliefs) + n_weights * size_of::<Lanes>())
    }

    /// Whether corrections of the belief must be told, see [`Self::correct`].
    pub fn has_cavities(&self) -> bool {
        self.held.is_some()
    }

    /// Numbers of all cavities, with margins.
    fn n_of_cavities(&self) -> usize {
        self.beliefs.len() - self.n_states * self.planes.length
    }

    /// Bytes of [`Self::to_bytes`].
    pub fn n_bytes(&self) -> usize {
        4 * self.n_of_cavities()
    }

    /// The cavities as bytes: what it knows that the belief does not tell.
    pub fn to_bytes(&self) -> Vec<u8> {
        let cavities = &self.beliefs[..self.n_of_cavities()];
        cavities.iter().flat_map(|p| p.to_le_bytes()).collect()
    }

    /// Goes on from such bytes of the same prediction and grid. Returns false, and changes nothing, if they do not fit.
    pub fn restore(&mut self, bytes: &[u8]) -> bool {
        let (numbers, rest) = bytes.as_chunks::<4>();
        let numbers: Vec<f32> = numbers.iter().map(|&p| f32::from_le_bytes(p)).collect();
        let n = self.n_of_cavities();
        let is_belief = |p: &f32| (0.0..=1.001).contains(p);
        let fits = numbers.len() == n && rest.is_empty() && numbers.iter().all(is_belief);
        if fits {
            self.beliefs[..n].copy_from_slice(&numbers);
        }
        fits
    }

    /// Writes the predictor of a posterior, both `[S, H, W]`, and predicts the cavities.
    ///
    /// # Panics
    /// If one of them has another length.
    pub fn predict(&mut self, belief: &[f32], predictor: &mut [f32]) {
        let (n_cells, at) = (self.shape.n_cells(), self.n_of_cavities());
        assert_eq!(
            belief.len(),
            self.n_states * n_cells,
            "belief: expected [S, H, W]"
        );
        let planes = self.beliefs[at..].chunks_exact_mut(self.planes.length);
        for (to, from) in planes.zip(belief.chunks_exact(n_cells)) {
            self.planes.put(self.shape, from, to);
        }
        vectorised(
            #[inline(always)]
            || {
                let mut chunk = 0;
                for row in 0..self.shape.height() {
                    for col in (0..self.shape.width()).step_by(LANES) {
                        self.predict_cells([row, col], chunk, predictor);
                        chunk += 1;
                    }
                }
            },
        );
        std::mem::swap(&mut self.beliefs, &mut self.next);
    }

    /// The predictors of the cells from one on, and of their cavities.
    #[inline(always)] // As are its parts, to be compiled for the vectors of this processor.
    fn predict_cells(&mut self, [row, col]: [usize; 2], chunk: usize, predictor: &mut [f32]) {
        let slots = self.layout.slots(chunk);
        let at = self.planes.place([row, col]);
        let of_belief = self.n_of_cavities();
        let of_state = self.planes.length;
        for (index, act) in self.layout.acts.iter().enumerate() {
            let is_held = self.held == Some(index);
            let n = self.offsets.len();
            for (neighbour, (place, offset)) in
                self.places.iter_mut().zip(&self.offsets).enumerate()
            {
                // Of a neighbour the cavity in which this cell is held, which lies opposite.
                let cavity = (n - 1 - neighbour) * self.n_states * of_state;
                let first = if is_held { cavity } else { of_belief };
                *place = (first + at).wrapping_add_signed(*offset);
            }
            let reading = Reading {
                slots,
                planes: &self.beliefs,
                length: of_state,
                places: &self.places,
            };
            let is_second_order = self.kind != PredictionKind::MeanField;
            self.work
                .predict(index, act, is_second_order, is_held, reading);
        }
        let n_lanes = LANES.min(self.shape.width() - col);
        let (n_cells, first) = (self.shape.n_cells(), row * self.shape.width() + col);
        for state in 0..self.n_states {
            let lanes = self.mixed(state, slots, of_belief + at, None);
            predictor[state * n_cells + first..][..n_lanes].copy_from_slice(&lanes[..n_lanes]);
        }
        let n_cavities = self.held.map_or(0, |_| self.offsets.len());
        for cavity in 0..n_cavities {
            let plane = cavity * self.n_states * of_state + at;
            for state in 0..self.n_states {
                let lanes = self.mixed(state, slots, plane, Some(cavity));
                let to = plane + state * of_state;
                self.next[to..][..n_lanes].copy_from_slice(&lanes[..n_lanes]);
            }
        }
    }

    /// The probability of a next state, over what the cells can be themselves.
    #[inline(always)]
    fn mixed(&self, state: usize, slots: &[Lanes], at: usize, cavity: Option<usize>) -> Lanes {
        let own = |own: usize| lanes_from(&self.beliefs, at + own * self.planes.length);
        let mut to = [0.0; LANES];
        for rest in &self.layout.rests {
            add_product(&mut to, own(rest.own), &slots[rest.next[state]]);
        }
        for (index, act) in self.layout.acts.iter().enumerate() {
            let Some(next) = act.next.iter().position(|next| *next == state) else {
                continue;
            };
            let distribution = match cavity {
                Some(cavity) if self.held == Some(index) => &self.work.held[cavity],
                _ => &self.work.distributions[index],
            };
            match act.own {
                Some(it) => add_product(&mut to, own(it), &distribution[next]),
                None => to = distribution[next],
            }
        }
        to
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

#[cfg(test)]
mod tests;
