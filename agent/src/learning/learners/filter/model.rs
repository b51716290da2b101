//! A learned filter as others need it: its estimator, and as part of their checkpoints.

use crate::learning::checkpoint::{check, wrong};
use crate::learning::learners::filter::fit::LearnedModel;
use anyhow::Result;
use emberwatch_belief::estimation::parameters::{Dimensions, Parameters};
use emberwatch_belief::estimation::{BayesFilter, Correlations, Estimator, correcting};
use emberwatch_network::NamedTensor;
use emberwatch_protocol::Shape;
use serde::{Deserialize, Serialize};

/// Before the names of the tensors of the filter that a neural belief corrects.
const FILTER: &str = "filter.";

impl LearnedModel {
    /// Before the first frame. `is_spatial`: whether its corrections reach the neighbours of visited cells.
    pub fn estimator(&self, is_spatial: bool, shape: Shape) -> Box<dyn Estimator> {
        let filter = BayesFilter::learned(&self.tables, self.tables.prior(shape));
        let neighbours = || (self.target, self.correlations.clone());
        correcting(filter, is_spatial.then(neighbours))
    }

    pub fn tensors(&self) -> Vec<NamedTensor> {
        let shapes = self.parameters.dimensions.shapes().into_iter();
        let names = Parameters::NAMES.iter().map(|name| (*name).to_owned());
        let tensors = names.zip(shapes).zip(self.parameters.tensors.clone());
        let tensors = tensors.map(|((name, shape), numbers)| (name, shape, numbers));
        tensors.collect()
    }

    /// Those of a filter that a neural belief corrects.
    pub fn corrected_tensors(&self) -> impl Iterator<Item = NamedTensor> + use<> {
        let named = |(name, shape, numbers)| (format!("{FILTER}{name}"), shape, numbers);
        self.tensors().into_iter().map(named)
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

    pub fn read(
        &self,
        sees_own_state: bool,
        find: impl Fn(&str, &[usize]) -> Result<Vec<f32>>,
    ) -> Result<LearnedModel> {
        let dimensions = Dimensions {
            sees_own_state,
            ..self.dimensions
        };
        let dimensions = dimensions.check();
        let dimensions =
            dimensions.map_err(|error| wrong("dimensions", "those of a filter", error))?;
        check_target(self.target, dimensions.n_states)?;
        let mut parameters = Parameters::zeros(dimensions);
        for (at, shape) in dimensions.shapes().iter().enumerate() {
            parameters.tensors[at] = find(Parameters::NAMES[at], shape)?;
        }
        let correlations = self.correlations.clone();
        Ok(LearnedModel::new(parameters, self.target, correlations))
    }

    /// One that a neural belief corrects, about so many observations.
    pub fn read_corrected(
        &self,
        n_observations: usize,
        find: impl Fn(&str, &[usize]) -> Result<Vec<f32>>,
    ) -> Result<LearnedModel> {
        let (name, got) = ("filter.n_observations", self.dimensions.n_observations);
        check(got == n_observations, name, n_observations, got)?;
        self.read(false, |name, shape| find(&format!("{FILTER}{name}"), shape))
    }
}

pub fn check_target(target: usize, n_states: usize) -> Result<()> {
    let expected = format!("less than {n_states}");
    check(target < n_states, "target", expected, target)
}
