//! The autoencoder as an estimator: a hidden vector that reads frames (paper eq. 9), and Bayes' rule at
//! visited cells (eq. 10).

use crate::estimation::follower::Follower;
use emberwatch_belief::estimation::bayes::correct;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::estimator::{Estimator, EstimatorError};
use emberwatch_model::Frame;
use emberwatch_network::{Autoencoder, NetworkError};
use ndarray::Array2;
use std::borrow::Cow;

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

    /// Where a follower of the network stands.
    pub fn at(network: &Autoencoder, follower: Follower) -> Self {
        Self {
            network: network.clone(),
            belief: follower.prediction().clone(),
            follower,
        }
    }
}

impl Estimator for AutoencoderEstimator {
    /// Bayes' rule with the learned `O` at visited cells (eq. 10); the predictor elsewhere.
    fn correct(&mut self, frame: &Frame) -> Result<(), EstimatorError> {
        let mut estimate = self.follower.prediction().clone();
        let likelihood = likelihood(&self.network).map_err(failed)?;
        correct(&mut estimate, &likelihood, frame)?;
        self.follower = self.follower.after(&self.network, frame).map_err(failed)?;
        self.belief = estimate;
        Ok(())
    }

    fn predict(&mut self) {
        self.belief.clone_from(self.follower.prediction());
    }

    fn belief(&self) -> &Belief {
        &self.belief
    }

    fn likelihood(&self) -> Option<Cow<'_, Array2<f64>>> {
        likelihood(&self.network).ok().map(Cow::Owned)
    }

    fn hidden(&self) -> Option<&[f32]> {
        Some(self.follower.hidden())
    }
}

fn failed(error: NetworkError) -> EstimatorError {
    EstimatorError::Network(error.into())
}

/// `P(y | x)` of a network, shape `[S, O]`.
pub fn likelihood(autoencoder: &Autoencoder) -> Result<Array2<f64>, NetworkError> {
    let shape = autoencoder.shape();
    let matrix = autoencoder.observation_matrix()?;
    let entry = |(state, value)| f64::from(matrix[value * shape.n_states + state]);
    let dim = (shape.n_states, shape.n_observations);
    Ok(Array2::from_shape_fn(dim, entry))
}
