//! The autoencoder as an estimator: a hidden vector that reads frames (paper eq. 9), and Bayes' rule at
//! visited cells (eq. 10).

use crate::belief::Belief;
use crate::estimator::ZeroEvidence;
use ::network::{Autoencoder, NetworkError, Window};
use protocol::{Frame, Probabilities};
use thiserror::Error;

/// Why a frame was not taken in; nothing has changed then.
#[derive(Debug, Error, PartialEq)]
pub enum StepError {
    /// The predictor rules out what was seen.
    #[error(transparent)]
    ZeroEvidence(#[from] ZeroEvidence),
    /// The network.
    #[error(transparent)]
    Network(#[from] NetworkError),
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
    /// [`StepError`]; nothing has changed then.
    pub fn step(&mut self, network: &Autoencoder, frame: &Frame) -> Result<Belief, StepError> {
        let estimate = self.correct(network, frame)?;
        let hidden = network.advance(&Window::new([frame]), &self.hidden)?;
        self.prediction = accepted(network.predict(&hidden)?);
        self.hidden = hidden;
        Ok(estimate)
    }

    /// Bayes' rule with the learned `O` at visited cells; the predictor elsewhere.
    fn correct(&self, network: &Autoencoder, frame: &Frame) -> Result<Belief, StepError> {
        let shape = network.shape();
        let (n_states, n_cells) = (shape.n_states, shape.grid.n_cells());
        let matrix = network.observation_matrix()?;
        let mut estimate = self.prediction.clone();
        let cells = estimate.probabilities_mut().as_slice_mut();
        let cells = cells.expect("invariant: beliefs are row-major");
        for (cell, observed) in frame.observed() {
            let likelihood = &matrix[usize::from(observed) * n_states..][..n_states];
            let prior = self.prediction.as_slice()[cell..].iter().step_by(n_cells);
            let joint = || {
                let pairs = prior.clone().zip(likelihood);
                pairs.map(|(&u, &o)| f64::from(u) * f64::from(o))
            };
            let evidence: f64 = joint().sum();
            if evidence <= 0.0 {
                let (cell, belief) = (shape.grid.cell(cell), prior.copied().collect());
                return Err(ZeroEvidence {
                    cell,
                    observed,
                    belief,
                }
                .into());
            }
            for (p, joint) in cells[cell..].iter_mut().step_by(n_cells).zip(joint()) {
                *p = (joint / evidence) as f32;
            }
        }
        Ok(estimate)
    }
}

fn accepted(probabilities: Probabilities) -> Belief {
    Belief::from_probabilities(probabilities).expect("invariant: a softmax is on the simplex")
}
