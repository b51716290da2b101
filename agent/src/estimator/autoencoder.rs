//! The paper's dynamic autoencoder (sections III.B and III.C) as an estimator.

use super::{Estimator, EstimatorError};
use crate::belief::Belief;
use crate::network::Autoencoder;
use protocol::{Frame, Grid};

/// A trained network that follows one world.
pub struct AutoencoderEstimator {
    network: Autoencoder,
    belief: Belief,
}

impl AutoencoderEstimator {
    /// Before the first frame.
    pub fn new(network: Autoencoder) -> Self {
        Self {
            belief: network.prediction().clone(),
            network,
        }
    }
}

impl Estimator for AutoencoderEstimator {
    fn correct(&mut self, frame: &Frame, _: Option<&Grid<u8>>) -> Result<(), EstimatorError> {
        self.belief = self.network.step(frame)?;
        Ok(())
    }

    fn predict(&mut self) {
        self.belief.clone_from(self.network.prediction());
    }

    fn belief(&self) -> &Belief {
        &self.belief
    }

    fn network(&self) -> Option<&Autoencoder> {
        Some(&self.network)
    }
}
