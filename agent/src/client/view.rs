//! The view of an agent that is published to observers.

use emberwatch_acting::rollout::ActingAgent;
use emberwatch_protocol::feed::View;
use std::ops::Range;
use std::time::Duration;

/// Returns an agent's belief with the policy and objective of its last path, which took `planning` to plan.
pub fn view(acting: &ActingAgent, world: u32, robots: Range<u32>, planning: Duration) -> View<'_> {
    View {
        world,
        robots,
        result: &acting.observation().world,
        belief: acting.agent.belief().probabilities(),
        intent: acting.agent.intent(planning),
    }
}
