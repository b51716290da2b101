//! The Bayes filter with learned parameters, and one whose corrections reach the neighbours of visited cells.
//!
//! Its kernels see the neighbours of a cell, or the cell's own state, too: what they see is the shape of a tensor.

use super::kind::{BeliefKind, Conditions, Input, LearnedBelief, LearnedBy};
use super::world_form::WorldForm;
use crate::checkpoint::{Part, check, wrong};
use anyhow::{Context, Result};
use emberwatch_belief::estimation::parameters::{Dimensions, Parameters, Tables};
use emberwatch_belief::estimation::prediction::PredictionKind;
use emberwatch_belief::estimation::{BayesFilter, Correlations, Estimator, correcting};
use emberwatch_model::Shape;
use emberwatch_network::NamedTensor;
use serde::{Deserialize, Serialize};

pub const LEARNED: BeliefKind = BeliefKind {
    name: "learned",
    label: "learned_filter",
    about: "a Bayes filter whose parameters were learned",
    input: Input::Frames,
    knows_model: false,
    learned_by: Some(LearnedBy {
        learner: "filter",
        decides: false,
        find: |learned| learned.get::<LearnedModel>().map(|model| model as _),
    }),
    chart: ("learned", [0x00, 0x9e, 0x73]),
    handover: None,
    build: |conditions| {
        Ok(model(conditions)?.estimator(false, PredictionKind::MeanField, conditions.shape))
    },
};

pub const LEARNED_SPATIAL: BeliefKind = BeliefKind {
    name: "learned+spatial",
    label: "learned_spatial_filter",
    about: "the same; what a cell shows corrects its neighbours, too",
    build: |conditions| {
        Ok(model(conditions)?.estimator(true, PredictionKind::MeanField, conditions.shape))
    },
    ..LEARNED
};

pub const LEARNED_CAVITIES: BeliefKind = BeliefKind {
    name: "learned+cavities",
    label: "learned_cavity_filter",
    about: "the learned filter, predicting as known+cavities does",
    build: |conditions| {
        Ok(model(conditions)?.estimator(false, PredictionKind::Cavities, conditions.shape))
    },
    ..LEARNED
};

pub const LEARNED_SPATIAL_CAVITIES: BeliefKind = BeliefKind {
    name: "learned+spatial+cavities",
    label: "learned_spatial_cavity_filter",
    about: "both: cavities, and what a cell shows corrects others",
    build: |conditions| {
        Ok(model(conditions)?.estimator(true, PredictionKind::Cavities, conditions.shape))
    },
    ..LEARNED
};

fn model<'a>(conditions: &Conditions<'a>) -> Result<&'a LearnedModel> {
    let model = conditions.learned.get::<LearnedModel>();
    model.context("checkpoint: expected one of a filter, got none")
}

/// A filter that was learned: all that acting on it needs.
#[derive(Debug, Clone, PartialEq)]
pub struct LearnedModel {
    /// The free numbers, and what they stand for.
    pub parameters: Parameters,
    pub tables: Tables,
    pub target: usize,
    /// How much that state of one cell says of its neighbours'.
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

    /// Before the first frame. `is_spatial`: whether its corrections reach the neighbours of visited cells.
    pub fn estimator(
        &self,
        is_spatial: bool,
        kind: PredictionKind,
        shape: Shape,
    ) -> Box<dyn Estimator> {
        let filter = BayesFilter::learned(&self.tables, self.tables.prior(shape));
        let filter = filter.predicting_learned(&self.tables, kind);
        let neighbours = || (self.target, self.correlations.clone());
        correcting(filter, is_spatial.then(neighbours))
    }

    /// Its parameters by name.
    pub fn tensors(&self) -> [NamedTensor; 3] {
        named_tensors(&self.parameters, "")
    }
}

impl LearnedBelief for LearnedModel {
    fn target(&self) -> usize {
        self.target
    }

    fn n_states(&self) -> usize {
        self.tables.dimensions.n_states
    }

    fn check_world(&self, world: &WorldForm) -> Result<()> {
        let dimensions = self.tables.dimensions;
        world.check_observations(dimensions.n_observations, dimensions.n_matrices)
    }
}

/// A learned filter, without its tensors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SavedModel {
    dimensions: Dimensions,
    target: usize,
    correlations: Correlations,
}

impl SavedModel {
    pub fn of(model: &LearnedModel) -> Self {
        Self {
            dimensions: model.parameters.dimensions,
            target: model.target,
            correlations: model.correlations.clone(),
        }
    }

    /// With its tensors.
    pub fn read(&self, part: &Part<'_>) -> Result<LearnedModel> {
        let dimensions = dimensions_of(self.dimensions, part)?;
        let parameters = read_parameters(dimensions, part, "")?;
        check_target(self.target, dimensions.n_states)?;
        let correlations = self.correlations.clone();
        Ok(LearnedModel::new(parameters, self.target, correlations))
    }

    pub fn n_observations(&self) -> usize {
        self.dimensions.n_observations
    }
}

/// Refuses a target that is no state.
pub fn check_target(target: usize, n_states: usize) -> Result<()> {
    let expected = format!("less than {n_states}");
    check(target < n_states, "target", expected, target)
}

/// The tensors of parameters, or of their moments, whose names end alike.
pub fn named_tensors(parameters: &Parameters, suffix: &str) -> [NamedTensor; 3] {
    let shapes = parameters.dimensions.shapes();
    [0, 1, 2].map(|at| {
        let name = format!("{}{suffix}", Parameters::NAMES[at]);
        (name, shapes[at].clone(), parameters.tensors[at].clone())
    })
}

/// Whether a filter's kernels see the cell's own state, by the axes of their tensor.
pub fn sees_own_state(part: &Part<'_>) -> bool {
    let shape = part.shape(Parameters::NAMES[0]);
    shape.is_some_and(|shape| shape.len() == 5)
}

/// A filter's dimensions with those that its tensors alone tell: observation matrices, and whether its kernels see the
/// cell's own state.
///
/// # Errors
/// If no filter has such, or had kernels for zones of land.
pub fn dimensions_of(dimensions: Dimensions, part: &Part<'_>) -> Result<Dimensions> {
    check(
        part.shape("zones").is_none(),
        "zones",
        "the same kernels in every cell",
        "kernels for each zone of land: train the filter again",
    )?;
    let dimensions = Dimensions {
        sees_own_state: sees_own_state(part),
        n_matrices: match part.shape(Parameters::NAMES[1]) {
            Some(&[_, n_matrices, _]) => n_matrices.max(1),
            _ => 1,
        },
        ..dimensions
    };
    let checked = dimensions.check();
    checked.map_err(|error| wrong("dimensions", "those of a filter", error))
}

/// Parameters or moments of such dimensions, whose names end alike.
pub fn read_parameters(
    dimensions: Dimensions,
    part: &Part<'_>,
    suffix: &str,
) -> Result<Parameters> {
    let shapes = dimensions.shapes();
    let tensor =
        |at: usize| part.tensor(&format!("{}{suffix}", Parameters::NAMES[at]), &shapes[at]);
    Ok(Parameters {
        dimensions,
        tensors: [tensor(0)?, tensor(1)?, tensor(2)?],
    })
}
