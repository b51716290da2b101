//! A belief that was learned, with all that estimators of it need, also as part of a checkpoint.

use crate::learning::checkpoint::{check, wrong};
use crate::learning::learners::filter::fit::LearnedModel;
use crate::learning::learners::neural::{NeuralModel, new_network};
use anyhow::Result;
use emberwatch_belief::estimation::parameters::{Dimensions, Parameters};
use emberwatch_belief::estimation::{BayesFilter, Correlations, Estimator, correcting};
use emberwatch_network::{Device, NamedTensor, NetworkError};
use emberwatch_protocol::Shape;
use serde::{Deserialize, Serialize};

/// Before the names of the tensors of the filter that a neural belief corrects.
const FILTER: &str = "filter.";

#[derive(Debug, Clone, PartialEq)]
pub enum LearnedBelief {
    Filter(Box<LearnedModel>),
    Neural(NeuralModel),
}

impl LearnedBelief {
    /// The state that pays most.
    pub fn target(&self) -> usize {
        match self {
            Self::Filter(model) => model.target,
            Self::Neural(model) => model.target,
        }
    }

    pub fn n_states(&self) -> usize {
        match self {
            Self::Filter(model) => model.tables.dimensions.n_states,
            Self::Neural(model) => model.network.n_observations(),
        }
    }

    /// Number of values that a cell may show to it.
    pub fn n_observations(&self) -> usize {
        match self {
            Self::Filter(model) => model.tables.dimensions.n_observations,
            Self::Neural(model) => model.network.n_observations(),
        }
    }

    /// Before the first frame. `is_spatial`: whether a filter's corrections reach the neighbours of visited cells.
    pub fn estimator(
        &self,
        is_spatial: bool,
        shape: Shape,
    ) -> Result<Box<dyn Estimator>, NetworkError> {
        Ok(match self {
            Self::Filter(model) => model.estimator(is_spatial, shape),
            Self::Neural(model) => Box::new(model.estimator(shape)?),
        })
    }

    /// Its tensors.
    pub fn tensors(&self) -> Result<Vec<NamedTensor>> {
        Ok(match self {
            Self::Filter(model) => model.tensors(),
            Self::Neural(model) => {
                let filter = model.filter.iter().flat_map(|it| it.corrected_tensors());
                model
                    .network
                    .parameters()?
                    .into_iter()
                    .chain(filter)
                    .collect()
            }
        })
    }
}

impl LearnedModel {
    /// Before the first frame. `is_spatial`: whether its corrections reach the neighbours of visited cells.
    pub fn estimator(&self, is_spatial: bool, shape: Shape) -> Box<dyn Estimator> {
        let filter = BayesFilter::learned(&self.tables, self.tables.prior(shape));
        let neighbours = || (self.target, self.correlations.clone());
        correcting(filter, is_spatial.then(neighbours))
    }

    fn tensors(&self) -> Vec<NamedTensor> {
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

/// A belief that was learned, without its tensors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum SavedBelief {
    Filter(Box<SavedModel>),
    Neural {
        n_observations: usize,
        target: usize,
        /// The filter that it corrects.
        filter: Option<Box<SavedModel>>,
    },
}

/// A learned filter, without its tensors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SavedModel {
    dimensions: Dimensions,
    target: usize,
    correlations: Correlations,
}

impl SavedBelief {
    pub fn of(belief: &LearnedBelief) -> Self {
        match belief {
            LearnedBelief::Filter(model) => Self::Filter(Box::new(SavedModel::of(model))),
            LearnedBelief::Neural(model) => Self::Neural {
                n_observations: model.network.n_observations(),
                target: model.target,
                filter: model
                    .filter
                    .as_deref()
                    .map(|it| Box::new(SavedModel::of(it))),
            },
        }
    }

    /// With its tensors, of which `find` gives the numbers by name and shape. `sees_own_state`: whether a filter's kernels
    /// do; a network computes on `device`.
    pub fn read(
        &self,
        sees_own_state: bool,
        find: impl Fn(&str, &[usize]) -> Result<Vec<f32>>,
        device: &Device,
    ) -> Result<LearnedBelief> {
        Ok(match self {
            Self::Filter(saved) => {
                LearnedBelief::Filter(Box::new(saved.read(sees_own_state, find)?))
            }
            Self::Neural {
                n_observations,
                target,
                filter,
            } => {
                check_target(*target, *n_observations)?;
                let mut network = new_network(*n_observations, device)?;
                network.set_parameters(&find)?;
                let filter = filter
                    .as_ref()
                    .map(|it| it.read_corrected(*n_observations, &find));
                LearnedBelief::Neural(NeuralModel {
                    network,
                    target: *target,
                    filter: filter.transpose()?.map(Box::new),
                })
            }
        })
    }
}

impl SavedModel {
    pub fn of(model: &LearnedModel) -> Self {
        Self {
            dimensions: model.parameters.dimensions,
            target: model.target,
            correlations: model.correlations.clone(),
        }
    }

    fn read(
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

fn check_target(target: usize, n_states: usize) -> Result<()> {
    let expected = format!("less than {n_states}");
    check(target < n_states, "target", expected, target)
}
