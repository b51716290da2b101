//! Checkpoints of learned filters: the learner, and the state of its robots.

use crate::checkpoint::check_belief;
use crate::learners::base::{Place, place};
use crate::learners::filter::fit::FilterFit;
use crate::rollout::Rollout;
use crate::rollout::agent::Agent;
use anyhow::Result;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_messages::observation::Observation;
use emberwatch_model::Shape;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::ops::Range;

/// A checkpoint of a learned filter, without its tensors.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct SavedFilter {
    pub fit: FilterFit,
    pub worlds: BTreeMap<u32, SavedRobot>,
}

/// The saved state of a robot: its last observation, the belief about the next step, and the estimate if paths are
/// planned on it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SavedRobot {
    place: Place,
    frame: Vec<u8>,
    belief: Belief,
    estimate: Option<Belief>,
}

impl SavedRobot {
    pub fn of(rollout: &Rollout) -> Self {
        let (agent, observation) = (&rollout.agent, rollout.observation());
        Self {
            place: place(observation),
            frame: observation.frame.as_bytes().to_vec(),
            belief: agent.belief().clone(),
            estimate: agent.estimate().cloned(),
        }
    }

    /// Whether a world's observation equals the saved observation. Worlds on different servers can have equal
    /// observations if their seeds, steps, flights and sensor noise are the same.
    pub fn is_of(&self, observation: &Observation) -> bool {
        self.place == place(observation) && self.frame == observation.frame.as_bytes()
    }

    /// Whether any robot's observation equals its saved observation.
    pub fn any_is_of(
        all: &BTreeMap<u32, Self>,
        robots: Range<u32>,
        observations: &[Observation],
    ) -> bool {
        robots.zip(observations).any(|(robot, observation)| {
            let saved = all.get(&robot);
            saved.is_some_and(|saved| saved.is_of(observation))
        })
    }

    /// Restores an agent's belief, and its estimate if paths are planned on it.
    pub fn restore(&self, agent: &mut Agent) {
        let filter = agent.estimator_mut().handover_mut();
        let is_taken = filter.is_some_and(|filter| filter.restore(&self.belief.to_bytes()));
        debug_assert!(is_taken, "invariant: the belief was checked");
        agent.remember_estimate(self.estimate.as_ref());
    }

    /// Checks the grid and the number of states of the beliefs.
    pub fn check(&self, n_states: usize, shape: Shape) -> Result<()> {
        check_belief("worlds.belief", &self.belief, n_states, shape)?;
        self.estimate
            .iter()
            .try_for_each(|estimate| check_belief("worlds.estimate", estimate, n_states, shape))
    }
}
