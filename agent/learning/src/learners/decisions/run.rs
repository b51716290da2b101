//! A robot that flies options: its agent, and its unfinished transitions.

use emberwatch_acting::rollout::ActingAgent;
use emberwatch_belief::planning::Proposal;
use emberwatch_model::Move;
use emberwatch_network::{Dqn, Track, Transition};

#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Held {
    pub(super) option: usize,
    pub(super) n_steps: u64,
}

pub(super) struct Run {
    pub(super) acting: ActingAgent,
    /// Features and reward of the last option, kept until the features of the next step complete the transition.
    pub(super) last: Option<(Vec<f32>, f32)>,
    pub(super) track: Track,
    pub(super) held: Held,
    pub(super) next: Option<(usize, Proposal)>,
}

impl Run {
    /// Creates a run. The agent's belief must already be corrected with the first observation.
    pub(super) fn begun(acting: ActingAgent, dqn: &Dqn) -> Self {
        Self {
            acting,
            last: None,
            track: dqn.track(),
            held: Held::default(),
            next: None,
        }
    }

    pub(super) fn propose(&mut self) -> Vec<Proposal> {
        let cell = self.acting.observation().robot.cell();
        self.acting.agent.propose(cell)
    }

    pub(super) fn take_up(&mut self) -> Vec<Move> {
        let next = self.next.take();
        let (option, proposal) = next.expect("invariant: an option was chosen");
        self.last = Some((proposal.features.to_vec(), 0.0));
        self.acting.agent.take_up(option, proposal).moves
    }

    pub(super) fn led_to(&mut self, features: &[f32], dqn: &Dqn) -> Option<Transition> {
        let (input, reward) = self.last.take()?;
        let is_terminated = self.acting.observation().world.terminated != 0;
        self.track.add(Transition {
            input,
            action: 0,
            reward,
            next: features.to_vec(),
            discount: dqn.discount(is_terminated),
        })
    }

    /// Ends the episode. Returns the transitions of the episode's last steps, whose next state is always the final
    /// state.
    pub(super) fn end(&mut self, dqn: &Dqn) -> Vec<Transition> {
        let features = features(&self.propose());
        let full = self.led_to(&features, dqn);
        full.into_iter().chain(self.track.end()).collect()
    }
}

pub(super) fn features(proposals: &[Proposal]) -> Vec<f32> {
    proposals.iter().flat_map(|it| it.features).collect()
}
