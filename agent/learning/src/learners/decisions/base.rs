//! What keeps the beliefs that decisions are made on.

use super::saved::SavedDecisions;
use crate::belief::LearnedBelief;
use crate::checkpoint::Contents;
use crate::learners::filter::form::WorldForm;
use crate::policy::{EstimatorKind, numbered_states};
use anyhow::Result;
use emberwatch_belief::estimation::{BayesFilter, Correlations, Estimator, correcting};
use emberwatch_model::{Model, Shape};
use emberwatch_network::Device;

/// What keeps the beliefs that decisions are made on, before a world's first frame.
pub struct Base {
    pub kind: EstimatorKind,
    /// The state that pays most.
    pub(super) target: usize,
    pub(super) state_names: Vec<String>,
    start: Start,
}

/// Where a belief begins.
enum Start {
    Known(Box<BayesFilter>),
    Learned(LearnedBelief, Shape),
}

impl Base {
    /// On a known model, whose filter is given.
    pub fn known(kind: EstimatorKind, filter: BayesFilter, model: &Model) -> Self {
        Self {
            kind,
            target: model.target_state(),
            state_names: model.state_names(),
            start: Start::Known(Box::new(filter)),
        }
    }

    pub fn learned(kind: EstimatorKind, belief: LearnedBelief, shape: Shape) -> Self {
        Self {
            kind,
            target: belief.target(),
            state_names: numbered_states(belief.n_states()),
            start: Start::Learned(belief, shape),
        }
    }

    /// Refuses worlds of another form.
    pub fn check_world(&self, world: &WorldForm<'_>) -> Result<()> {
        match &self.start {
            // Made of the world's own model.
            Start::Known(_) => Ok(()),
            Start::Learned(belief, _) => belief.check_world(world),
        }
    }

    pub(super) fn estimator(&self) -> Result<Box<dyn Estimator>> {
        let is_spatial = self.kind.is_spatial();
        match &self.start {
            Start::Known(filter) => {
                let neighbours = || (self.target, Correlations::default());
                Ok(correcting(*filter.clone(), is_spatial.then(neighbours)))
            }
            Start::Learned(belief, shape) => belief.estimator(is_spatial, *shape),
        }
    }

    /// What was learned, unless the model is known.
    pub(super) fn belief(&self) -> Option<&LearnedBelief> {
        match &self.start {
            Start::Known(_) => None,
            Start::Learned(belief, _) => Some(belief),
        }
    }

    /// What a checkpoint's decisions are on, if that was learned; a network computes on `device`.
    pub fn saved(contents: &Contents, shape: Shape, device: &Device) -> Result<Option<Self>> {
        let saved: SavedDecisions = contents.state()?;
        let belief = saved.belief(contents, device)?;
        Ok(belief.map(|belief| Self::learned(saved.estimator, belief, shape)))
    }
}
