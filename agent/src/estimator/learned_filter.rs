//! A Bayes filter with the model's own structure and learned parameters.
//!
//! It corrects and predicts like [`super::Filter`] (paper eqs. 5 and 6, without bias), with weights
//! `w`, observation matrix `O` and first belief that maximise the likelihood of what was seen
//! ([`Trainer`]). Read [`parameters`], then [`window`] for one pass and its derivatives, then
//! [`trainer`].
//!
//! What the data do not tell: the scale of `w` (eq. 3 divides it out), and the order and, in part, the
//! meaning of the states. Two parameter sets that predict every observation alike cannot be told
//! apart; so a cell that "often looks latent" may stand for the true latent one, whose cells mostly
//! look normal. Labels are anchored where learning starts (state i looks like observation i), and
//! by a prior on the state that pays most: it is seen almost surely.

pub mod adam;
mod layout;
mod operator;
pub mod parameters;
mod stored;
pub mod trainer;
pub mod vector;
pub mod window;

pub use adam::Adam;
pub use parameters::{Dimensions, DimensionsError, Parameters, Tables};
pub use trainer::{Iterates, NotFinite, Trainer, Update};

use super::ZeroEvidence;
use crate::belief::Belief;
use layout::Layout;
use operator::Operator;
use protocol::grid::Probabilities;
use protocol::{Frame, Shape};
use vector::{Lanes, Vectorised, on_widest};

/// A learned filter of one world.
#[derive(Debug, Clone)]
pub struct LearnedFilter {
    tables: Tables,
    operator: Operator<f32>,
    belief: Belief,
    /// Posterior and predictor with their margins.
    planes: [Vec<f32>; 2],
    factors: Vec<f32>,
}

impl LearnedFilter {
    /// A filter before its first frame, which believes the learned first belief.
    pub fn new(tables: &Tables, shape: Shape) -> Self {
        let (height, width) = shape.dim();
        let dim = (tables.initial.len(), height, width);
        let prior = Probabilities::from_shape_fn(dim, |(state, _, _)| tables.initial[state]);
        let prior = Belief::from_probabilities(prior);
        Self::with_prior(
            tables,
            prior.expect("invariant: a softmax sums to one, as does a checked model's initial"),
        )
    }

    /// A filter that believes something else.
    ///
    /// # Panics
    /// If the prior has another number of states.
    pub fn with_prior(tables: &Tables, prior: Belief) -> Self {
        let dimensions = tables.dimensions;
        assert_eq!(prior.n_states(), dimensions.n_states, "prior: other states");
        let layout = Layout::new(prior.shape(), dimensions.n_states, dimensions.kernel);
        Self {
            operator: Operator::new(layout, &tables.kernel),
            planes: [layout.planes(), layout.planes()],
            factors: vec![0.0; layout.plane],
            tables: tables.clone(),
            belief: prior,
        }
    }

    /// Takes newer parameters of the same dimensions; the belief stays.
    pub fn set(&mut self, tables: &Tables) {
        self.operator.set(&tables.kernel);
        self.tables.clone_from(tables);
    }

    /// The predictor `u_k`, or after [`Self::correct`] the posterior `p_k`.
    pub fn belief(&self) -> &Belief {
        &self.belief
    }

    /// The parameters.
    pub fn tables(&self) -> &Tables {
        &self.tables
    }

    /// Believes something else of the same shape.
    ///
    /// # Panics
    /// If the shape is another.
    pub fn set_belief(&mut self, belief: Belief) {
        let dim = |belief: &Belief| belief.probabilities().dim();
        assert_eq!(dim(&belief), dim(&self.belief), "belief: another shape");
        self.belief = belief;
    }

    /// Bayes' rule on the visited cells (eq. 5).
    ///
    /// # Errors
    /// [`ZeroEvidence`]; the belief is then as it was. Learned parameters are positive: it takes a
    /// model's own, with zeros, to get there.
    ///
    /// # Panics
    /// If the frame is of another grid or has other observations.
    pub fn correct(&mut self, frame: &Frame) -> Result<(), ZeroEvidence> {
        let shape = self.belief.shape();
        assert_eq!(frame.values().dim(), shape.dim(), "frame: another grid");
        for (cell, value) in frame.observed() {
            if self.joint(cell, value).sum::<f32>() <= 0.0 {
                let states = 0..self.belief.n_states();
                let belief = states.map(|state| self.probability(state, cell));
                return Err(ZeroEvidence {
                    cell: shape.cell(cell),
                    observed: value,
                    belief: belief.collect(),
                });
            }
        }
        for (cell, value) in frame.observed() {
            let joint: Vec<f32> = self.joint(cell, value).collect();
            let evidence: f32 = joint.iter().sum();
            let cell = shape.cell(cell);
            let belief = self.belief.probabilities_mut();
            for (state, joint) in joint.into_iter().enumerate() {
                belief[[state, cell.row, cell.col]] = joint / evidence;
            }
        }
        Ok(())
    }

    /// The predictor of the next step (eq. 6).
    pub fn predict(&mut self) {
        on_widest(Predict(self));
    }

    /// `u O` of a cell for each state.
    fn joint(&self, cell: usize, value: u8) -> impl Iterator<Item = f32> + '_ {
        let n_observations = self.tables.dimensions.n_observations;
        let seen_as = self.tables.likelihood[usize::from(value)..]
            .iter()
            .step_by(n_observations);
        seen_as
            .enumerate()
            .map(move |(state, likelihood)| self.probability(state, cell) * likelihood)
    }

    fn probability(&self, state: usize, cell: usize) -> f32 {
        self.belief.as_slice()[state * self.belief.shape().n_cells() + cell]
    }
}

struct Predict<'a>(&'a mut LearnedFilter);

impl Vectorised for Predict<'_> {
    type Number = f32;
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes<f32>>(self) {
        let filter = self.0;
        let layout = filter.operator.layout;
        let [posterior, predictor] = &mut filter.planes;
        layout.load(filter.belief.as_slice(), posterior, |p| p);
        filter
            .operator
            .forward::<V>(posterior, predictor, &mut filter.factors);
        let belief = filter.belief.probabilities_mut().as_slice_mut();
        let belief = belief.expect("invariant: beliefs are row-major");
        layout.unload(predictor, belief, |p| p);
    }
}
