//! The autoencoder's recurrent state in one world: its hidden vector and its predictor (paper eq. 9).

use emberwatch_belief::estimation::belief::Belief;
use emberwatch_model::{Frame, Probabilities};
use emberwatch_network::{Autoencoder, NetworkError, Window};

/// The recurrent state of a network in one world. All methods must receive the same network.
#[derive(Debug, Clone)]
pub struct Follower {
    /// The hidden vector `h_k`.
    pub hidden: Vec<f32>,
    /// The predictor `u_{k+1}`.
    pub prediction: Belief,
}

impl Follower {
    /// Creates the state before the first frame: `h ~ N(0, I)`, determined by the network's seed.
    pub fn new(network: &Autoencoder) -> Result<Self, NetworkError> {
        let hidden = network.first_hidden();
        let prediction = accepted(network.predict(&hidden)?);
        Ok(Self { hidden, prediction })
    }

    /// Returns the state after a frame (eq. 9).
    pub fn after(&self, network: &Autoencoder, frame: &Frame) -> Result<Self, NetworkError> {
        let hidden = network.advance(&Window::new([frame]), &self.hidden)?;
        let prediction = accepted(network.predict(&hidden)?);
        Ok(Self { hidden, prediction })
    }
}

fn accepted(probabilities: Probabilities) -> Belief {
    Belief::from_probabilities(probabilities).expect("invariant: a softmax is on the simplex")
}
