//! The tensors of a DQN, from which a run resumes.

use super::learner::{Dqn, on_cpu};
use crate::error::NetworkError;
use crate::tensors::{NamedTensor, found, named_numbers, set};
use crate::variables::Variables;

impl Dqn {
    /// Returns the variables of both networks under PyTorch's names, and Adam's moments, for a checkpoint.
    pub fn named_tensors(&self) -> Vec<NamedTensor> {
        on_cpu(named_numbers(&self.groups()))
    }

    pub(super) fn groups(&self) -> [(&'static str, &Variables); 3] {
        [
            ("dqn.network.", self.adam.variables()),
            ("dqn.target.", &self.target_variables),
            ("dqn.adam.", self.adam.moments()),
        ]
    }

    /// Loads the tensors that [`Self::named_tensors`] returned for a DQN with the same inputs and actions, after this
    /// number of updates. The replay buffer does not change. `find` returns the values of a tensor with a given name
    /// and shape.
    ///
    /// # Errors
    /// If `find` fails. The DQN is then unchanged.
    pub fn load<E: From<NetworkError>>(
        &mut self,
        find: impl Fn(&str, &[usize]) -> Result<Vec<f32>, E>,
        n_updates: u64,
    ) -> Result<(), E> {
        let changes = found(&self.groups(), find)?;
        set(&changes).map_err(NetworkError::from)?;
        self.adam.set_steps(n_updates);
        Ok(())
    }
}
