//! The saved state of a robot, from which its agent resumes.

use super::base::{Place, place};
use crate::checkpoint::{check, check_belief};
use crate::rollout::Rollout;
use crate::rollout::agent::Agent;
use anyhow::Result;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_messages::observation::Observation;
use emberwatch_model::Shape;
use serde::{Deserialize, Serialize};

/// A robot's last observation, and the belief of its agent.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct ResumePoint {
    place: Place,
    frame: Vec<u8>,
    /// The estimator's handover bytes.
    belief: Vec<u8>,
    /// The estimate p_k, if paths are planned on it.
    estimate: Option<Belief>,
}

impl ResumePoint {
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

    /// Whether a world's observation equals the saved observation.
    pub(super) fn is_of(&self, observation: &Observation) -> bool {
        self.place == place(observation) && self.frame == observation.frame.as_bytes()
    }

    /// Restores an agent's estimator, and its estimate if paths are planned on it.
    ///
    /// # Errors
    /// If the bytes belong to another kind of estimator.
    pub(super) fn restore(&self, agent: &mut Agent) -> Result<()> {
        let estimator = agent.estimator_mut().handover_mut();
        let is_taken = estimator.is_some_and(|it| it.restore(&self.belief));
        check(
            is_taken,
            "worlds.belief",
            "a belief of its estimator",
            "another",
        )?;
        agent.remember_estimate(self.estimate.as_ref());
        Ok(())
    }

    /// Checks the grid and the number of states of the estimate.
    pub(super) fn check(&self, n_states: usize, shape: Shape) -> Result<()> {
        let mut estimates = self.estimate.iter();
        estimates.try_for_each(|it| check_belief("worlds.estimate", it, n_states, shape))
    }
}

#[cfg(test)]
impl ResumePoint {
    /// Creates a resume point with this estimate, and without an estimator's bytes.
    pub(super) fn with_estimate(observation: &Observation, estimate: Belief) -> Self {
        Self {
            place: place(observation),
            frame: observation.frame.as_bytes().to_vec(),
            belief: Vec::new(),
            estimate: Some(estimate),
        }
    }
}
