//! Estimators that ignore frames: oracles, which receive the hidden states, and a constant belief.

use crate::estimation::belief::{Belief, BeliefError};
use crate::estimation::estimator::{Estimator, EstimatorError, Told};
use crate::estimation::prediction::Prediction;
use emberwatch_model::ModelError;
use emberwatch_model::{Frame, Grid, Model};

/// An oracle that receives X_k, the states that the frame observed.
///
/// Its belief gives these states probability 1, until [`Estimator::predict`] moves it one step ahead for the next path.
pub struct Oracle {
    belief: Belief,
    prediction: Prediction,
}

/// A constant belief, as if nothing were ever observed.
pub struct Unchanging(pub Belief);

impl Oracle {
    /// Creates an oracle whose belief is `prior` until it receives hidden states.
    ///
    /// # Errors
    /// If the model cannot be simulated on the prior's grid.
    pub fn new(model: &Model, prior: Belief) -> Result<Self, ModelError> {
        Ok(Self {
            prediction: Prediction::known(model, &prior, false)?,
            belief: prior,
        })
    }
}

impl Estimator for Oracle {
    fn correct(&mut self, _: &Frame) -> Result<(), EstimatorError> {
        Ok(())
    }

    fn predict(&mut self) {
        self.prediction.predict(&mut self.belief);
    }

    fn belief(&self) -> &Belief {
        &self.belief
    }
}

impl Told for Oracle {
    fn tell(&mut self, states: &Grid<u8>) -> Result<(), BeliefError> {
        self.belief = Belief::from_states(states, self.belief.n_states())?;
        Ok(())
    }
}

impl Estimator for Unchanging {
    fn correct(&mut self, _: &Frame) -> Result<(), EstimatorError> {
        Ok(())
    }

    fn predict(&mut self) {}

    fn belief(&self) -> &Belief {
        &self.0
    }
}
