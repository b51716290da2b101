//! The autoencoder as an estimator: a hidden vector that reads frames (paper eq. 9), and Bayes' rule at
//! visited cells (eq. 10).

use crate::estimation::belief::Belief;
use crate::estimation::estimator::{Estimator, EstimatorError};
use crate::estimation::filter::correct;
use crate::estimation::scoring::{Score, score};
use ::network::{Autoencoder, NetworkError, Window};
use ndarray::Array2;
use protocol::{Frame, Grid, Probabilities};

/// A network that follows one world.
pub struct AutoencoderEstimator {
    network: Autoencoder,
    follower: Follower,
    /// The estimate `p_k` or the predictor `u_{k+1}`.
    belief: Belief,
}

impl AutoencoderEstimator {
    /// Before the first frame.
    ///
    /// # Errors
    /// Where the network's device fails.
    pub fn new(network: &Autoencoder) -> Result<Self, NetworkError> {
        Ok(Self::at(network, Follower::new(network)?))
    }

    /// Where another follower was.
    pub fn at(network: &Autoencoder, follower: Follower) -> Self {
        Self {
            network: network.shared(),
            belief: follower.prediction().clone(),
            follower,
        }
    }
}

impl Estimator for AutoencoderEstimator {
    fn correct(&mut self, frame: &Frame, _: Option<&Grid<u8>>) -> Result<(), EstimatorError> {
        self.belief = self.follower.step(&self.network, frame)?;
        Ok(())
    }

    fn predict(&mut self) {
        self.belief.clone_from(self.follower.prediction());
    }

    fn belief(&self) -> &Belief {
        &self.belief
    }

    fn score(&self, frame: &Frame) -> Result<Option<Score>, EstimatorError> {
        let likelihood = likelihood(&self.network)?;
        Ok(Some(score(&self.belief, &likelihood, frame)))
    }

    fn follower(&self) -> Option<&Follower> {
        Some(&self.follower)
    }
}

/// What a network knows of one world. Every method takes the same network.
#[derive(Debug, Clone)]
pub struct Follower {
    /// `h_k`.
    hidden: Vec<f32>,
    /// The predictor `u_k` of the next frame.
    prediction: Belief,
}

impl Follower {
    /// Before the first frame: `h ~ N(0, I)`, the same for a network's seed.
    ///
    /// # Errors
    /// As the network's device.
    pub fn new(network: &Autoencoder) -> Result<Self, NetworkError> {
        let hidden = network.first_hidden();
        let prediction = accepted(network.predict(&hidden)?);
        Ok(Self { hidden, prediction })
    }

    /// Where another follower was.
    pub fn at(hidden: Vec<f32>, prediction: Belief) -> Self {
        Self { hidden, prediction }
    }

    /// The hidden vector.
    pub fn hidden(&self) -> &[f32] {
        &self.hidden
    }

    /// The predictor of the next frame.
    pub fn prediction(&self) -> &Belief {
        &self.prediction
    }

    /// Reads a frame: returns the estimate `p_k`, after which [`Self::prediction`] is `u_{k+1}` and
    /// [`Self::hidden`] is `h_{k+1}`.
    ///
    /// # Errors
    /// [`EstimatorError`]; nothing has changed then.
    pub fn step(&mut self, network: &Autoencoder, frame: &Frame) -> Result<Belief, EstimatorError> {
        let estimate = self.correct(network, frame)?;
        let hidden = network.advance(&Window::new([frame]), &self.hidden)?;
        self.prediction = accepted(network.predict(&hidden)?);
        self.hidden = hidden;
        Ok(estimate)
    }

    /// Bayes' rule with the learned `O` at visited cells; the predictor elsewhere.
    fn correct(&self, network: &Autoencoder, frame: &Frame) -> Result<Belief, EstimatorError> {
        let mut estimate = self.prediction.clone();
        correct(&mut estimate, &likelihood(network)?, frame)?;
        Ok(estimate)
    }
}

fn accepted(probabilities: Probabilities) -> Belief {
    Belief::from_probabilities(probabilities).expect("invariant: a softmax is on the simplex")
}

/// `P(y | x)` of a network, shape `[S, O]`.
///
/// # Errors
/// As the network's device.
pub fn likelihood(autoencoder: &Autoencoder) -> Result<Array2<f64>, NetworkError> {
    let shape = autoencoder.shape();
    let matrix = autoencoder.observation_matrix()?;
    let entry = |(state, value)| f64::from(matrix[value * shape.n_states + state]);
    let dim = (shape.n_states, shape.n_observations);
    Ok(Array2::from_shape_fn(dim, entry))
}
