//! Decisions that were learned: which option is worth most.

use crate::beliefs::BeliefKind;
use emberwatch_belief::planning::BasisKind;
use emberwatch_network::Dqn;
use std::sync::Arc;

/// What policies with the goal `learned` and the planner `options` act on.
#[derive(Debug, Clone)]
pub struct LearnedDecisions {
    pub scorer: Arc<Dqn>,
    /// The belief that they were learned on.
    pub belief: &'static BeliefKind,
    /// What paths are planned on.
    pub basis: BasisKind,
    /// Width of the beam search that plans the options.
    pub beam_width: usize,
}

/// Two that were read are never taken for the same.
impl PartialEq for LearnedDecisions {
    fn eq(&self, _: &Self) -> bool {
        false
    }
}
