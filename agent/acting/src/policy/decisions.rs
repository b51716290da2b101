//! Learned decisions: the choice of the option with the highest value.

use crate::beliefs::BeliefKind;
use emberwatch_network::Dqn;
use std::sync::Arc;

/// The learned values that are used by policies with the planner `options` and the goal `learned`.
pub struct LearnedDecisions {
    pub scorer: Arc<Dqn>,
    /// The belief that the decisions were learned on.
    pub belief: &'static BeliefKind,
    /// Width of the beam search that plans options.
    pub beam_width: usize,
}

/// Two loaded values are never equal, because networks are not compared.
impl PartialEq for LearnedDecisions {
    fn eq(&self, _: &Self) -> bool {
        false
    }
}
