//! A learned filter as others need it: its estimator, and as part of their checkpoints.

use crate::checkpoint::{Part, check};
use crate::learners::filter::fit::LearnedModel;
use crate::learners::filter::form::{Form, WorldForm, named_tensors, zones_tensor};
use anyhow::Result;
use emberwatch_belief::estimation::parameters::Dimensions;
use emberwatch_belief::estimation::{BayesFilter, Correlations, Estimator, correcting};
use emberwatch_model::Shape;
use emberwatch_network::NamedTensor;
use serde::{Deserialize, Serialize};

/// Before the names of the tensors of the filter that a neural belief corrects.
const FILTER: &str = "filter.";

impl LearnedModel {
    /// Before the first frame. `is_spatial`: whether its corrections reach the neighbours of visited cells.
    ///
    /// # Errors
    /// If it was learned on zones of another grid.
    pub fn estimator(&self, is_spatial: bool, shape: Shape) -> Result<Box<dyn Estimator>> {
        if let Some(zones) = &self.tables.zones {
            let (height, width) = zones.dim();
            let (expected, got) = (shape.to_string(), Shape::new(height, width)?.to_string());
            check(
                got == expected,
                "zones",
                format!("a map of {expected} cells"),
                got,
            )?;
        }
        let filter = BayesFilter::learned(&self.tables, self.tables.prior(shape));
        let neighbours = || (self.target, self.correlations.clone());
        Ok(correcting(filter, is_spatial.then(neighbours)))
    }

    /// Refuses worlds of another form than those that it was learned in.
    pub fn check_world(&self, world: &WorldForm<'_>) -> Result<()> {
        world.check_filter(&self.tables)
    }

    pub fn tensors(&self) -> Vec<NamedTensor> {
        let tensors = named_tensors(&self.parameters, "").into_iter();
        tensors.chain(zones_tensor(&self.parameters)).collect()
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

    pub fn read(&self, sees_own_state: bool, part: &Part<'_>) -> Result<LearnedModel> {
        let dimensions = Dimensions {
            sees_own_state,
            ..self.dimensions
        };
        let parameters = Form::read(dimensions, part)?.parameters(part, "")?;
        check_target(self.target, parameters.dimensions.n_states)?;
        let correlations = self.correlations.clone();
        Ok(LearnedModel::new(parameters, self.target, correlations))
    }

    /// One that a neural belief corrects, about so many observations.
    pub fn read_corrected(&self, n_observations: usize, part: &Part<'_>) -> Result<LearnedModel> {
        let (name, got) = ("filter.n_observations", self.dimensions.n_observations);
        check(got == n_observations, name, n_observations, got)?;
        self.read(false, &part.part(FILTER))
    }
}

pub fn check_target(target: usize, n_states: usize) -> Result<()> {
    let expected = format!("less than {n_states}");
    check(target < n_states, "target", expected, target)
}
