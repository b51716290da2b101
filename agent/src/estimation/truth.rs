//! Beliefs of those who are told the hidden states, and of who is told nothing: what better estimation could bring.

use crate::estimation::belief::{Belief, BeliefError};
use crate::estimation::estimator::{Estimator, EstimatorError};
use protocol::model::ModelError;
use protocol::{Frame, Grid, Model, Probabilities, Transition};

/// Told X_k: certain of it, and one prediction ahead of it for the next path.
pub struct Oracle {
    belief: Belief,
    transition: Transition,
}

/// Told X_{k+1}, the state that the next path will meet; the prior until then, always if nobody tells.
pub struct Clairvoyant(pub Belief);

impl Oracle {
    /// Before it is told anything.
    pub fn new(model: &Model, prior: Belief) -> Result<Self, ModelError> {
        Ok(Self {
            transition: Transition::new(model, prior.shape())?,
            belief: prior,
        })
    }
}

impl Estimator for Oracle {
    fn correct(&mut self, _: &Frame, truth: Option<&Grid<u8>>) -> Result<(), EstimatorError> {
        let truth = truth.ok_or(EstimatorError::NoTruth)?;
        self.belief = Belief::from_states(truth, self.belief.n_states())?;
        Ok(())
    }

    fn predict(&mut self) {
        let mut next = Probabilities::zeros(self.belief.view().dim());
        let belief = self.belief.probabilities_mut();
        self.transition.apply(belief, &mut next);
        *belief = next;
    }

    fn belief(&self) -> &Belief {
        &self.belief
    }

    fn sees_frames(&self) -> bool {
        false
    }
}

impl Estimator for Clairvoyant {
    fn correct(&mut self, _: &Frame, _: Option<&Grid<u8>>) -> Result<(), EstimatorError> {
        Ok(())
    }

    fn predict(&mut self) {}

    fn belief(&self) -> &Belief {
        &self.0
    }

    fn foresee(&mut self, next: &Grid<u8>) -> Result<(), BeliefError> {
        self.0 = Belief::from_states(next, self.0.n_states())?;
        Ok(())
    }

    fn sees_frames(&self) -> bool {
        false
    }
}
