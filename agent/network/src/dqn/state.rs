//! The saved state of a DQN, from which a run resumes: named tensors and a [`SavedDqn`].

use super::learner::{Dqn, on_cpu};
use super::track::{Track, Transition};
use crate::error::NetworkError;
use crate::tensors::{NamedTensor, found, named_numbers, set};
use crate::variables::Variables;
use serde::{Deserialize, Serialize};

/// The state of a DQN except its tensors, settings and seed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SavedDqn {
    /// Number of updates so far.
    pub n_updates: u64,
    /// The replay buffer, the oldest transition first.
    pub transitions: Vec<Transition>,
}

impl Dqn {
    /// Returns the tensors of a checkpoint: the variables of the network and of its target network under PyTorch's
    /// names, and Adam's moments.
    pub fn named_tensors(&self) -> Vec<NamedTensor> {
        on_cpu(named_numbers(&self.groups()))
    }

    /// Returns the variables of the network and of its target network, and Adam's moments.
    pub(super) fn groups(&self) -> [(&'static str, &Variables); 3] {
        [
            ("dqn.network.", self.adam.variables()),
            ("dqn.target.", &self.target_variables),
            ("dqn.adam.", self.adam.moments()),
        ]
    }

    /// Returns the rest of the state that a resumed run needs.
    pub fn saved(&self) -> SavedDqn {
        SavedDqn {
            n_updates: self.n_updates(),
            transitions: self.memory.iter().cloned().collect(),
        }
    }

    /// Loads the state that [`Self::named_tensors`] and [`Self::saved`] returned for a DQN with the same inputs and
    /// actions. This DQN then learns exactly as the saved one would have, bit for bit. If the saved replay buffer
    /// exceeds the capacity, only the latest transitions are kept. `find` returns the values of a tensor with a given
    /// name and shape.
    ///
    /// # Errors
    /// If `find` fails, or a transition does not fit the DQN. The DQN is then unchanged.
    pub fn load<E: From<NetworkError>>(
        &mut self,
        find: impl Fn(&str, &[usize]) -> Result<Vec<f32>, E>,
        saved: &SavedDqn,
    ) -> Result<(), E> {
        let changes = found(&self.groups(), find)?;
        let mut transitions = saved.transitions.iter().enumerate();
        transitions.try_for_each(|(at, transition)| self.check_transition(at, transition))?;
        set(&changes).map_err(NetworkError::from)?;
        let forgotten = saved.transitions.len().saturating_sub(self.settings.replay);
        self.memory = saved.transitions[forgotten..].to_vec().into();
        self.adam.set_steps(saved.n_updates);
        Ok(())
    }

    /// Resumes the saved track of an episode. Returns an empty track if the saved one has a different
    /// [`n_step`](super::DqnSettings::n_step), or more open steps than such a track can have.
    ///
    /// # Errors
    /// If a step does not fit the DQN.
    pub fn resume_track(&self, saved: Track) -> Result<Track, NetworkError> {
        let track = self.track();
        let length = saved.open.len();
        if saved.n_step != track.n_step || length >= saved.n_step {
            return Ok(track);
        }
        let mut steps = saved.open.iter().enumerate();
        steps.try_for_each(|(at, step)| self.check_transition(at, step))?;
        Ok(saved)
    }

    fn check_transition(&self, at: usize, transition: &Transition) -> Result<(), NetworkError> {
        let Transition {
            input,
            action,
            reward,
            next,
            discount,
        } = transition;
        let mut numbers = input.iter().chain(next).chain([reward]);
        let is_finite = numbers.all(|number| number.is_finite());
        if self.fits(transition) && is_finite && (0.0..=1.0).contains(discount) {
            return Ok(());
        }
        let (n_inputs, n_outputs) = (self.shape.n_inputs, self.shape.n_outputs);
        let n_next = self.shape.n_numbers();
        let flaw = if is_finite {
            ""
        } else {
            ", with a number that is not finite"
        };
        Err(NetworkError::Transition {
            at,
            expected: format!(
                "{n_inputs} inputs, {n_next} next inputs, an action below {n_outputs}, a discount from 0 to 1 and \
                 finite numbers"
            ),
            got: format!(
                "{} inputs, {} next inputs, action {action}, discount {discount}{flaw}",
                input.len(),
                next.len()
            ),
        })
    }
}
