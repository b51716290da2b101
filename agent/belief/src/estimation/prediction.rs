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
mod cavities;
mod cells;
mod lanes;

pub use acts::Weights;

use crate::estimation::belief::Belief;
use acts::Layout;
use cells::{Reading, Work};
use emberwatch_model::Shape;
use emberwatch_model::vectors::vectorised;
use lanes::{LANES, Lanes, Planes, add_product, lanes_from};

/// How a predictor is computed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
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
        let layout = Layout::new(weights);
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

    /// Starts every cavity from a belief.
    fn begin(&mut self, belief: &Belief) {
        let n_numbers = self.n_states * self.planes.length;
        for planes in self.beliefs.chunks_exact_mut(n_numbers) {
            self.planes.put(self.shape, belief.as_slice(), planes);
        }
    }

    pub fn kind(&self) -> PredictionKind {
        self.kind
    }

    /// Returns the number of cavities: one per neighbour, or 0.
    fn n_cavities(&self) -> usize {
        self.held.map_or(0, |_| self.offsets.len())
    }

    /// Returns where the belief itself starts in `beliefs`: after the cavities.
    fn start_of_belief(&self) -> usize {
        self.n_cavities() * self.n_states * self.planes.length
    }

    /// Writes the predictor of a posterior, both `[S, H, W]`, and predicts the cavities.
    ///
    /// # Panics
    /// If one of them has another length.
    pub fn predict(&mut self, belief: &[f32], predictor: &mut [f32]) {
        let (n_cells, start) = (self.shape.n_cells(), self.start_of_belief());
        assert_eq!(
            belief.len(),
            self.n_states * n_cells,
            "belief: expected [S, H, W]"
        );
        self.planes
            .put(self.shape, belief, &mut self.beliefs[start..]);
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
        let slots = self.layout.slots.of_chunk(chunk);
        let at = self.planes.place([row, col]);
        let of_belief = self.start_of_belief();
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
        for cavity in 0..self.n_cavities() {
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
}

#[cfg(test)]
mod tests;
