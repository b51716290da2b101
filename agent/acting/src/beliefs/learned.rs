//! Bayes filters with learned parameters.
//!
//! The kinds differ in whether corrections reach the neighbours of visited cells.

use super::kind::{BeliefKind, Conditions, Input, LearnedBelief, LearnedBy, Traits};
use super::world_form::WorldForm;
use anyhow::{Context, Result};
use emberwatch_belief::estimation::parameters::{Parameters, Tables};
use emberwatch_belief::estimation::{BayesFilter, Correlations, Filter, SpatialFilter, correcting};
use emberwatch_model::Shape;

pub const LEARNED: BeliefKind = BeliefKind {
    name: "learned",
    about: "a Bayes filter with learned parameters",
    input: Input::Frames,
    knows_model: false,
    has_options: true,
    is_of_observations: false,
    is_parallel: false,
    learned_by: Some(LearnedBy {
        learner: "filter",
        decides: false,
        find: |learned| learned.get::<LearnedModel>().map(|model| model as _),
    }),
    chart: ("learned", [0x00, 0x9e, 0x73]),
    traits: Traits::of_filter::<BayesFilter>(),
    build: |conditions| Ok(model(conditions)?.estimator(false, conditions.shape)),
};

pub const LEARNED_SPATIAL: BeliefKind = BeliefKind {
    name: "learned+spatial",
    about: "learned, where observations also correct neighbouring cells",
    traits: Traits::of_filter::<SpatialFilter>(),
    build: |conditions| Ok(model(conditions)?.estimator(true, conditions.shape)),
    ..LEARNED
};

fn model<'a>(conditions: &Conditions<'a>) -> Result<&'a LearnedModel> {
    let model = conditions.learned.get::<LearnedModel>();
    model.context("checkpoint: expected a learned filter, got none")
}

/// A learned filter: everything that an agent needs to act on its belief.
#[derive(Debug, Clone, PartialEq)]
pub struct LearnedModel {
    pub parameters: Parameters,
    /// The weights and probabilities computed from the parameters.
    pub tables: Tables,
    /// The state with the highest reward.
    pub target: usize,
    /// Correlations of the target state between neighbouring cells.
    pub correlations: Correlations,
}

impl LearnedModel {
    pub fn new(parameters: Parameters, target: usize, correlations: Correlations) -> Self {
        Self {
            tables: parameters.tables(),
            parameters,
            target,
            correlations,
        }
    }

    /// Builds an estimator. If `is_spatial`, corrections reach the neighbours of visited cells.
    pub fn estimator(&self, is_spatial: bool, shape: Shape) -> Box<dyn Filter> {
        let filter = BayesFilter::learned(&self.tables, self.tables.prior(shape));
        let neighbours = || (self.target, self.correlations.clone());
        correcting(filter, is_spatial.then(neighbours))
    }
}

impl LearnedBelief for LearnedModel {
    fn kind(&self) -> &'static BeliefKind {
        &LEARNED
    }

    fn target(&self) -> usize {
        self.target
    }

    fn n_states(&self) -> usize {
        self.tables.dimensions.n_states
    }

    fn check_world(&self, world: &WorldForm) -> Result<()> {
        world.check_observations(self.tables.dimensions.n_observations)
    }
}
