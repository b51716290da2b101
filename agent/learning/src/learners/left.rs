//! Where a checkpoint left a robot.

use super::base::{Place, place};
use crate::checkpoint::{check, check_belief};
use crate::rollout::Rollout;
use crate::rollout::agent::Agent;
use anyhow::Result;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_messages::observation::Observation;
use emberwatch_model::Shape;
use serde::{Deserialize, Serialize};

/// What a robot saw last, and what its agent believed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Left {
    place: Place,
    frame: Vec<u8>,
    /// All that the estimator remembers.
    belief: Vec<u8>,
    /// The estimate p_k, where paths are planned on it.
    estimate: Option<Belief>,
}

impl Left {
    pub(super) fn of(rollout: &Rollout) -> Self {
        let (agent, observation) = (&rollout.agent, rollout.observation());
        let belief = agent.estimator().handover().map(|it| it.to_bytes());
        Self {
            place: place(observation),
            frame: observation.frame.as_bytes().to_vec(),
            belief: belief.unwrap_or_default(),
            estimate: agent.estimate().cloned(),
        }
    }

    /// Whether a world shows what it showed then.
    pub(super) fn is_of(&self, observation: &Observation) -> bool {
        self.place == place(observation) && self.frame == observation.frame.as_bytes()
    }

    /// Gives an agent what its estimator remembered, and the estimate if its paths are planned on that.
    ///
    /// # Errors
    /// If it is not of such an estimator.
    pub(super) fn restore(&self, agent: &mut Agent) -> Result<()> {
        let estimator = agent.estimator_mut().handover_mut();
        let is_taken = estimator.is_some_and(|it| it.restore(&self.belief));
        check(
            is_taken,
            "worlds.belief",
            "that of its estimator",
            "another",
        )?;
        agent.remember_estimate(self.estimate.as_ref());
        Ok(())
    }

    /// Refuses an estimate of another grid or about other states.
    pub(super) fn check(&self, n_states: usize, shape: Shape) -> Result<()> {
        let mut estimates = self.estimate.iter();
        estimates.try_for_each(|it| check_belief("worlds.estimate", it, n_states, shape))
    }
}

#[cfg(test)]
impl Left {
    /// Of a robot whose agent remembers nothing.
    pub(super) fn blank(observation: &Observation) -> Self {
        Self {
            place: place(observation),
            frame: observation.frame.as_bytes().to_vec(),
            belief: Vec::new(),
            estimate: None,
        }
    }
}
