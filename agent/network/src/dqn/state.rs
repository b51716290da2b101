//! What a resumed run needs of the DQN: tensors by name and a [`SavedDqn`] out, and in again.

use super::learner::{Dqn, on_cpu};
use super::track::{Track, Transition};
use crate::error::NetworkError;
use crate::tensors::{NamedTensor, found, named_numbers, set};
use crate::variables::Variables;
use serde::{Deserialize, Serialize};

/// A DQN without its tensors, settings and seed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SavedDqn {
    /// Updates so far.
    pub n_updates: u64,
    /// The replay, the oldest transition first.
    pub transitions: Vec<Transition>,
}

impl Dqn {
    /// The network and its target by PyTorch's names, and Adam's moments.
    pub fn named_tensors(&self) -> Vec<NamedTensor> {
        on_cpu(named_numbers(&self.groups()))
    }

    /// The network's variables, its target's, and Adam's moments.
    pub(super) fn groups(&self) -> [(&'static str, &Variables); 3] {
        [
            ("dqn.network.", self.adam.variables()),
            ("dqn.target.", &self.target_variables),
            ("dqn.adam.", self.adam.moments()),
        ]
    }

    /// What else a resumed run needs.
    pub fn saved(&self) -> SavedDqn {
        SavedDqn {
            n_updates: self.n_updates(),
            transitions: self.memory.iter().cloned().collect(),
        }
    }

    /// Takes over what [`Self::named_tensors`] and [`Self::saved`] gave, of a DQN of the same inputs and
    /// actions: from here on, it learns as that one would have, bit for bit. Of a longer replay the latest
    /// transitions stay. `find` gives the numbers of a name and shape.
    ///
    /// # Errors
    /// As of `find`, or for a transition of another DQN; nothing has changed then.
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

    /// Resumes the saved track of an episode; without steps if its transitions were of another length.
    ///
    /// # Errors
    /// For a step of another DQN.
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
        Err(NetworkError::Transition {
            at,
            expected: format!(
                "{n_inputs} finite inputs, an action below {n_outputs} and a discount from 0 to 1"
            ),
            got: format!("{}, {action} and {discount}", input.len()),
        })
    }
}
