//! A robot that flies options: its agent, and what the last option led to.

use super::saved::{Held, SavedRun};
use crate::learners::left::Left;
use crate::rollout::Rollout;
use anyhow::Result;
use emberwatch_belief::planning::Proposal;
use emberwatch_model::Move;
use emberwatch_network::{Dqn, Track, Transition};

pub(super) struct Run {
    pub(super) rollout: Rollout,
    /// The features of the option flown last and its reward, until what follows is known.
    pub(super) last: Option<(Vec<f32>, f32)>,
    pub(super) track: Track,
    pub(super) held: Held,
    /// What is flown next.
    pub(super) next: Option<(usize, Proposal)>,
}

impl Run {
    /// Where an agent has taken in what its world shows.
    pub(super) fn begun(rollout: Rollout, dqn: &Dqn) -> Self {
        Self {
            rollout,
            last: None,
            track: dqn.track(),
            held: Held::default(),
            next: None,
        }
    }

    pub(super) fn propose(&mut self) -> Vec<Proposal> {
        let cell = self.rollout.observation().robot.cell();
        self.rollout.agent.propose(cell)
    }

    /// The path of the option that was chosen.
    pub(super) fn take_up(&mut self) -> Vec<Move> {
        let next = self.next.take();
        let (option, proposal) = next.expect("invariant: an option was chosen");
        self.last = Some((proposal.features.to_vec(), 0.0));
        self.rollout.agent.take_up(option, proposal).moves
    }

    /// Adds the step that led to these features of all options; returns the transition that it completes.
    pub(super) fn led_to(&mut self, features: &[f32], dqn: &Dqn) -> Option<Transition> {
        let (input, reward) = self.last.take()?;
        let is_terminated = self.rollout.observation().world.terminated != 0;
        self.track.add(Transition {
            input,
            action: 0,
            reward,
            next: features.to_vec(),
            discount: dqn.discount(is_terminated),
        })
    }

    /// Ends the episode; returns the transitions of its last steps, up to the options of its last state.
    pub(super) fn end(&mut self, dqn: &Dqn) -> Vec<Transition> {
        let features = features(&self.propose());
        let full = self.led_to(&features, dqn);
        full.into_iter().chain(self.track.end()).collect()
    }

    pub(super) fn saved(&self) -> SavedRun {
        SavedRun {
            left: Left::of(&self.rollout),
            memory: self.rollout.agent.memory.clone(),
            last: self.last.clone(),
            track: self.track.clone(),
            held: self.held,
        }
    }

    /// Goes on from where a checkpoint left it, with an agent that has not yet taken in what its world shows.
    pub(super) fn restore(saved: SavedRun, mut rollout: Rollout, dqn: &Dqn) -> Result<Self> {
        saved.left.restore(&mut rollout.agent)?;
        rollout.agent.memory = saved.memory;
        Ok(Self {
            rollout,
            last: saved.last,
            track: dqn.resume_track(saved.track)?,
            held: saved.held,
            next: None,
        })
    }
}

/// The features of all options, one after the other.
pub(super) fn features(proposals: &[Proposal]) -> Vec<f32> {
    proposals.iter().flat_map(|it| it.features).collect()
}
