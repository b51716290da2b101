//! What an agent shows to observers.

use emberwatch_learning::rollout::Rollout;
use emberwatch_protocol::feed::View;
use std::ops::Range;
use std::time::Duration;

/// What an agent believes after a step; `planning`: time that its plan took.
pub fn view(rollout: &Rollout, world: u32, robots: Range<u32>, planning: Duration) -> View<'_> {
    View {
        world,
        robots,
        result: &rollout.observation().world,
        belief: rollout.agent.belief().probabilities(),
        intent: rollout.agent.intent(planning),
    }
}
