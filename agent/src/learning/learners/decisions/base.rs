//! What keeps the beliefs that decisions are made on.

use super::saved::SavedDecisions;
use crate::learning::checkpoint::Contents;
use crate::learning::learners::filter::fit::LearnedModel;
use crate::policy::{EstimatorKind, numbered_states};
use anyhow::Result;
use emberwatch_belief::estimation::{BayesFilter, Correlations, Estimator, correcting};
use emberwatch_protocol::{Model, Shape};

/// What keeps the beliefs that decisions are made on, before a world's first frame.
pub struct Base {
    pub kind: EstimatorKind,
    filter: BayesFilter,
    /// The state that pays most.
    pub(super) target: usize,
    correlations: Correlations,
    pub(super) state_names: Vec<String>,
    /// What the filter learned, unless the model is known.
    pub(super) model: Option<LearnedModel>,
}

impl Base {
    /// On a known model, whose filter is given.
    pub fn known(kind: EstimatorKind, filter: BayesFilter, model: &Model) -> Self {
        Self {
            kind,
            filter,
            target: model.target_state(),
            correlations: Correlations::default(),
            state_names: model.state_names(),
            model: None,
        }
    }

    pub fn learned(kind: EstimatorKind, model: LearnedModel, shape: Shape) -> Self {
        Self {
            kind,
            filter: BayesFilter::learned(&model.tables, model.tables.prior(shape)),
            target: model.target,
            correlations: model.correlations.clone(),
            state_names: numbered_states(model.tables.dimensions.n_states),
            model: Some(model),
        }
    }

    /// Number of values that a cell may show to it.
    pub fn n_observations(&self) -> usize {
        let likelihood = self.filter.likelihood();
        likelihood.map_or(0, |likelihood| likelihood.ncols())
    }

    pub(super) fn estimator(&self) -> Box<dyn Estimator> {
        let neighbours = || (self.target, self.correlations.clone());
        let neighbours = self.kind.is_spatial().then(neighbours);
        correcting(self.filter.clone(), neighbours)
    }

    /// What a checkpoint's decisions are on, if that was learned.
    pub fn saved(contents: &Contents, shape: Shape) -> Result<Option<Self>> {
        let saved: SavedDecisions = contents.state()?;
        let model = saved.model(contents)?;
        Ok(model.map(|model| Self::learned(saved.estimator, model, shape)))
    }
}
