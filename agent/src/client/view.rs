//! The view of an agent that is published to observers.

use emberwatch_acting::rollout::Rollout;
use emberwatch_protocol::feed::View;
use std::ops::Range;
use std::time::Duration;

/// Returns an agent's belief after a step, with the policy and objective behind its last path. `planning` is the time
/// that planning took.
pub fn view(rollout: &Rollout, world: u32, robots: Range<u32>, planning: Duration) -> View<'_> {
    View {
        world,
        robots,
        result: &rollout.observation().world,
        belief: rollout.agent.belief().probabilities(),
        intent: rollout.agent.intent(planning),
    }
}
