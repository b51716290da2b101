//! Bayes filters with learned parameters.
//!
//! The kinds differ in whether corrections reach the neighbours of visited cells.

use super::kind::{BeliefKind, Conditions, Input, LearnedBelief, LearnedBy};
use super::world_form::WorldForm;
use crate::checkpoint::{Part, check, wrong};
use anyhow::{Context, Result};
use emberwatch_belief::estimation::parameters::{Dimensions, Parameters, Tables};
use emberwatch_belief::estimation::{BayesFilter, Correlations, Estimator, correcting};
use emberwatch_model::Shape;
use emberwatch_network::NamedTensor;
use serde::{Deserialize, Serialize};

pub const LEARNED: BeliefKind = BeliefKind {
    name: "learned",
    about: "a Bayes filter with learned parameters",
    input: Input::Frames,
    knows_model: false,
    has_options: true,
    is_parallel: false,
    learned_by: Some(LearnedBy {
        learner: "filter",
        decides: false,
        find: |learned| learned.get::<LearnedModel>().map(|model| model as _),
    }),
    chart: ("learned", [0x00, 0x9e, 0x73]),
    handover: None,
    build: |conditions| Ok(model(conditions)?.estimator(false, conditions.shape)),
};

pub const LEARNED_SPATIAL: BeliefKind = BeliefKind {
    name: "learned+spatial",
    about: "learned, where observations also correct neighbouring cells",
    build: |conditions| Ok(model(conditions)?.estimator(true, conditions.shape)),
    ..LEARNED
};

/// Returns the learned filter of the checkpoint.
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

    /// Builds an estimator before its first frame.
    ///
    /// If `is_spatial`, corrections reach the neighbours of visited cells.
    pub fn estimator(&self, is_spatial: bool, shape: Shape) -> Box<dyn Estimator> {
        let filter = BayesFilter::learned(&self.tables, self.tables.prior(shape));
        let neighbours = || (self.target, self.correlations.clone());
        correcting(filter, is_spatial.then(neighbours))
    }

    /// Returns the parameters as named tensors.
    pub fn tensors(&self) -> [NamedTensor; 3] {
        named_tensors(&self.parameters, "")
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

/// The part of a [`LearnedModel`] that a checkpoint stores besides the tensors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SavedModel {
    dimensions: Dimensions,
    target: usize,
    correlations: Correlations,
}

impl SavedModel {
    /// Extracts the stored part of a model.
    pub fn of(model: &LearnedModel) -> Self {
        Self {
            dimensions: model.parameters.dimensions,
            target: model.target,
            correlations: model.correlations.clone(),
        }
    }

    /// Loads the model, with its tensors from a part of a checkpoint.
    pub fn read(&self, part: &Part<'_>) -> Result<LearnedModel> {
        let parameters = read_parameters(self.dimensions, part, "")?;
        check_target(self.target, self.dimensions.n_states)?;
        let correlations = self.correlations.clone();
        Ok(LearnedModel::new(parameters, self.target, correlations))
    }

    /// Returns the number of observations.
    pub fn n_observations(&self) -> usize {
        self.dimensions.n_observations
    }
}

/// Checks that the target is the index of a state.
pub fn check_target(target: usize, n_states: usize) -> Result<()> {
    let expected = format!("less than {n_states}");
    check(target < n_states, "target", expected, target)
}

/// Returns the tensors of parameters or moments. Their names are [`Parameters::NAMES`] with a suffix.
pub fn named_tensors(parameters: &Parameters, suffix: &str) -> [NamedTensor; 3] {
    let shapes = parameters.dimensions.shapes();
    [0, 1, 2].map(|at| {
        let name = format!("{}{suffix}", Parameters::NAMES[at]);
        (name, shapes[at].clone(), parameters.tensors[at].clone())
    })
}

/// Loads parameters or moments with the given dimensions. Their names are [`Parameters::NAMES`] with a suffix.
///
/// # Errors
/// If a dimension is out of range, or a tensor is missing or has another form.
pub fn read_parameters(
    dimensions: Dimensions,
    part: &Part<'_>,
    suffix: &str,
) -> Result<Parameters> {
    let checked = dimensions.check();
    checked.map_err(|error| wrong("dimensions", "valid dimensions of a filter", error))?;
    let names = Parameters::NAMES.map(|name| format!("{name}{suffix}"));
    let shapes = dimensions.shapes();
    let tensor = |at: usize| part.tensor(&names[at], &shapes[at]);
    Ok(Parameters {
        dimensions,
        tensors: [tensor(0)?, tensor(1)?, tensor(2)?],
    })
}
