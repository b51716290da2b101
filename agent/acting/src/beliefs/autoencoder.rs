//! The autoencoder as an estimator: frames update a hidden vector (paper eq. 9), and Bayes' rule corrects visited cells
//! (eq. 10).

use super::kind::{BeliefKind, Input, LearnedBelief, LearnedBy, Traits, cast};
use super::learned::LEARNED;
use super::world_form::WorldForm;
use anyhow::{Context, Result, ensure};
use emberwatch_belief::estimation::bayes::correct;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::estimator::{Estimator, EstimatorError, ObservationModel};
use emberwatch_model::Frame;
use emberwatch_network::{Autoencoder, Dqn, NetworkError, Window};
use ndarray::Array2;
use std::borrow::Cow;
use std::sync::Arc;

pub const AUTOENCODER: BeliefKind = BeliefKind {
    name: "autoencoder",
    about: "the paper's dynamic autoencoder",
    input: Input::Frames,
    knows_model: false,
    has_options: false,
    is_of_observations: false,
    is_parallel: true,
    learned_by: Some(LearnedBy {
        learner: "autoencoder",
        decides: true,
        find: |learned| learned.get::<AutoencoderModel>().map(|model| model as _),
    }),
    chart: LEARNED.chart,
    traits: Traits {
        observation_model: Some(|it| cast::<AutoencoderEstimator>(it)),
        ..Traits::NONE
    },
    build: |conditions| {
        let model = conditions.learned.get::<AutoencoderModel>();
        let model = model.context("checkpoint: expected a learned autoencoder, got none")?;
        let estimator = AutoencoderEstimator::new(&model.autoencoder);
        Ok(Box::new(estimator.context("checkpoint")?))
    },
};

/// The result of Algorithm 1: everything that an agent needs to act on its belief.
pub struct AutoencoderModel {
    pub autoencoder: Autoencoder,
    /// Chooses an objective from the hidden vector (paper section III.E).
    pub dqn: Arc<Dqn>,
    /// The state with the highest reward.
    pub target: usize,
}

/// Two loaded models are never equal, because networks are not compared.
impl PartialEq for AutoencoderModel {
    fn eq(&self, _: &Self) -> bool {
        false
    }
}

impl LearnedBelief for AutoencoderModel {
    fn kind(&self) -> &'static BeliefKind {
        &AUTOENCODER
    }

    fn target(&self) -> usize {
        self.target
    }

    fn n_states(&self) -> usize {
        self.autoencoder.shape().n_states
    }

    fn check_world(&self, world: &WorldForm) -> Result<()> {
        let shape = self.autoencoder.shape();
        world.check_observations(shape.n_observations)?;
        ensure!(
            shape.grid == world.shape,
            "checkpoint: expected a network for the world's grid, {}, got one for {}",
            world.shape,
            shape.grid
        );
        Ok(())
    }
}

pub struct AutoencoderEstimator {
    network: Autoencoder,
    hidden: Vec<f32>,
    prediction: Belief,
    /// The estimate `p_k` or the predictor `u_{k+1}`.
    belief: Belief,
}

impl AutoencoderEstimator {
    /// Creates the estimator before its first frame, with `h ~ N(0, I)`, determined by the network's seed.
    pub fn new(network: &Autoencoder) -> Result<Self, NetworkError> {
        let hidden = network.first_hidden();
        let prediction = predictor(network, &hidden)?;
        Ok(Self {
            network: network.clone(),
            hidden,
            belief: prediction.clone(),
            prediction,
        })
    }

    /// Returns the hidden vector `h_k` from which the belief is computed, the input of the DQN (paper section III.E).
    pub fn hidden(&self) -> &[f32] {
        &self.hidden
    }
}

impl Estimator for AutoencoderEstimator {
    /// Applies Bayes' rule with the learned `O` at visited cells (eq. 10). Other cells keep the predictor.
    fn correct(&mut self, frame: &Frame) -> Result<(), EstimatorError> {
        let mut estimate = self.prediction.clone();
        let likelihood = likelihood(&self.network).map_err(failed)?;
        correct(&mut estimate, &likelihood, frame)?;
        let hidden = self.network.advance(&Window::new([frame]), &self.hidden);
        let hidden = hidden.map_err(failed)?;
        self.prediction = predictor(&self.network, &hidden).map_err(failed)?;
        (self.hidden, self.belief) = (hidden, estimate);
        Ok(())
    }

    fn predict(&mut self) {
        self.belief.clone_from(&self.prediction);
    }

    fn belief(&self) -> &Belief {
        &self.belief
    }
}

impl ObservationModel for AutoencoderEstimator {
    fn likelihood(&self) -> Option<Cow<'_, Array2<f64>>> {
        likelihood(&self.network).ok().map(Cow::Owned)
    }
}

fn predictor(network: &Autoencoder, hidden: &[f32]) -> Result<Belief, NetworkError> {
    let belief = Belief::from_probabilities(network.predict(hidden)?);
    Ok(belief.expect("invariant: a softmax is on the simplex"))
}

fn failed(error: NetworkError) -> EstimatorError {
    EstimatorError::Network(error.into())
}

/// Returns `P(y | x)` of a network, shape `[S, O]`.
pub fn likelihood(autoencoder: &Autoencoder) -> Result<Array2<f64>, NetworkError> {
    let shape = autoencoder.shape();
    let matrix = autoencoder.observation_matrix()?;
    let entry = |(state, value)| f64::from(matrix[value * shape.n_states + state]);
    let dim = (shape.n_states, shape.n_observations);
    Ok(Array2::from_shape_fn(dim, entry))
}
