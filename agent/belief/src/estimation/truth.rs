//! Beliefs that frames do not change: of those who are told the hidden states, and of one who learns nothing.

use crate::estimation::belief::{Belief, BeliefError};
use crate::estimation::estimator::{Estimator, EstimatorError, Told};
use emberwatch_model::ModelError;
use emberwatch_model::{Frame, Grid, Model, Probabilities, Transition};

/// Told X_k: certain of it, and one prediction ahead of it for the next path.
pub struct Oracle {
    belief: Belief,
    transition: Transition,
}

/// Told X_{k+1}, the state that the next path will meet.
pub struct Clairvoyant(pub Belief);

/// Believes the same for ever, as if nothing were seen.
pub struct Unchanging(pub Belief);

impl Oracle {
    /// Before it is told anything.
    ///
    /// # Errors
    /// If the model cannot be simulated on the prior's grid.
    pub fn new(model: &Model, prior: Belief) -> Result<Self, ModelError> {
        Ok(Self {
            transition: Transition::new(model, prior.shape())?,
            belief: prior,
        })
    }
}

impl Estimator for Oracle {
    fn correct(&mut self, _: &Frame) -> Result<(), EstimatorError> {
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

    fn told(&mut self) -> Option<&mut dyn Told> {
        Some(self)
    }
}

impl Told for Oracle {
    fn tell(&mut self, states: &Grid<u8>) -> Result<(), BeliefError> {
        self.belief = Belief::from_states(states, self.belief.n_states())?;
        Ok(())
    }
}

impl Estimator for Clairvoyant {
    fn correct(&mut self, _: &Frame) -> Result<(), EstimatorError> {
        Ok(())
    }

    fn predict(&mut self) {}

    fn belief(&self) -> &Belief {
        &self.0
    }

    fn told(&mut self) -> Option<&mut dyn Told> {
        Some(self)
    }
}

impl Told for Clairvoyant {
    fn tell(&mut self, states: &Grid<u8>) -> Result<(), BeliefError> {
        self.0 = Belief::from_states(states, self.0.n_states())?;
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
