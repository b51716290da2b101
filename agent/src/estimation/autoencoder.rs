//! The autoencoder as an estimator: a hidden vector that reads frames (paper eq. 9), and Bayes' rule at
//! visited cells (eq. 10).

use crate::estimation::bayes::correct;
use crate::estimation::belief::Belief;
use crate::estimation::estimator::{Estimator, EstimatorError};
use crate::estimation::follower::{Follower, accepted};
use crate::estimation::scoring::{Score, score};
use ::network::{Autoencoder, NetworkError, Window};
use ndarray::Array2;
use protocol::{Frame, Grid};

pub struct AutoencoderEstimator {
    network: Autoencoder,
    follower: Follower,
    /// The estimate `p_k` or the predictor `u_{k+1}`.
    belief: Belief,
}

impl AutoencoderEstimator {
    /// Before the first frame.
    pub fn new(network: &Autoencoder) -> Result<Self, NetworkError> {
        Ok(Self::at(network, Follower::new(network)?))
    }

    pub fn at(network: &Autoencoder, follower: Follower) -> Self {
        Self {
            network: network.clone(),
            belief: follower.prediction().clone(),
            follower,
        }
    }
}

impl Estimator for AutoencoderEstimator {
    fn correct(&mut self, frame: &Frame, _: Option<&Grid<u8>>) -> Result<(), EstimatorError> {
        let estimate = estimate(&self.network, self.follower.prediction(), frame)?;
        let window = Window::new([frame]);
        let hidden = self.network.advance(&window, self.follower.hidden())?;
        let prediction = accepted(self.network.predict(&hidden)?);
        self.follower = Follower::at(hidden, prediction);
        self.belief = estimate;
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

/// Bayes' rule with the learned `O` at visited cells (eq. 10); the predictor elsewhere.
fn estimate(
    network: &Autoencoder,
    prediction: &Belief,
    frame: &Frame,
) -> Result<Belief, EstimatorError> {
    let mut estimate = prediction.clone();
    correct(&mut estimate, &likelihood(network)?, frame)?;
    Ok(estimate)
}

/// `P(y | x)` of a network, shape `[S, O]`.
pub fn likelihood(autoencoder: &Autoencoder) -> Result<Array2<f64>, NetworkError> {
    let shape = autoencoder.shape();
    let matrix = autoencoder.observation_matrix()?;
    let entry = |(state, value)| f64::from(matrix[value * shape.n_states + state]);
    let dim = (shape.n_states, shape.n_observations);
    Ok(Array2::from_shape_fn(dim, entry))
}
