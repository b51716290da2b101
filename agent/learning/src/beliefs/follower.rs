//! What the autoencoder knows of one world: its hidden vector and its predictor (paper eq. 9).

use emberwatch_belief::estimation::belief::Belief;
use emberwatch_model::{Frame, Probabilities};
use emberwatch_network::{Autoencoder, NetworkError, Window};
use serde::{Deserialize, Serialize};

/// What a network knows of one world. Every method takes the same network.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Follower {
    /// `h_k`.
    pub hidden: Vec<f32>,
    pub prediction: Belief,
}

impl Follower {
    /// Before the first frame: `h ~ N(0, I)`, the same for a network's seed.
    pub fn new(network: &Autoencoder) -> Result<Self, NetworkError> {
        let hidden = network.first_hidden();
        let prediction = accepted(network.predict(&hidden)?);
        Ok(Self { hidden, prediction })
    }

    pub fn at(hidden: Vec<f32>, prediction: Belief) -> Self {
        Self { hidden, prediction }
    }

    /// After a frame (eq. 9).
    pub fn after(&self, network: &Autoencoder, frame: &Frame) -> Result<Self, NetworkError> {
        let hidden = network.advance(&Window::new([frame]), &self.hidden)?;
        let prediction = accepted(network.predict(&hidden)?);
        Ok(Self { hidden, prediction })
    }

    pub fn hidden(&self) -> &[f32] {
        &self.hidden
    }

    pub fn prediction(&self) -> &Belief {
        &self.prediction
    }
}

fn accepted(probabilities: Probabilities) -> Belief {
    Belief::from_probabilities(probabilities).expect("invariant: a softmax is on the simplex")
}
