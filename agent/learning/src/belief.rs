//! A belief that was learned, with all that estimators of it need, also as part of a checkpoint.

use crate::checkpoint::Part;
use crate::learners::filter::fit::LearnedModel;
use crate::learners::filter::form::WorldForm;
use crate::learners::filter::model::{SavedModel, check_target};
use crate::learners::neural::{NeuralModel, new_network};
use anyhow::Result;
use emberwatch_belief::estimation::Estimator;
use emberwatch_model::Shape;
use emberwatch_network::{Device, NamedTensor};
use serde::{Deserialize, Serialize};

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

    /// Refuses worlds of another form than those that it was learned in.
    pub fn check_world(&self, world: &WorldForm<'_>) -> Result<()> {
        match self {
            Self::Filter(model) => model.check_world(world),
            Self::Neural(model) => {
                world.check_observations(model.network.n_observations(), 1)?;
                let mut filters = model.filter.iter();
                filters.try_for_each(|filter| filter.check_world(world))
            }
        }
    }

    /// Before the first frame. `is_spatial`: whether a filter's corrections reach the neighbours of visited cells.
    pub fn estimator(&self, is_spatial: bool, shape: Shape) -> Result<Box<dyn Estimator>> {
        Ok(match self {
            Self::Filter(model) => model.estimator(is_spatial, shape)?,
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

    /// With its tensors. `sees_own_state`: whether a filter's kernels do; a network computes on `device`.
    pub fn read(
        &self,
        sees_own_state: bool,
        part: &Part<'_>,
        device: &Device,
    ) -> Result<LearnedBelief> {
        let find = |name: &str, shape: &[usize]| part.tensor(name, shape);
        Ok(match self {
            Self::Filter(saved) => {
                LearnedBelief::Filter(Box::new(saved.read(sees_own_state, part)?))
            }
            Self::Neural {
                n_observations,
                target,
                filter,
            } => {
                check_target(*target, *n_observations)?;
                let mut network = new_network(*n_observations, device)?;
                network.set_parameters(find)?;
                let filter = filter
                    .as_ref()
                    .map(|it| it.read_corrected(*n_observations, part));
                LearnedBelief::Neural(NeuralModel {
                    network,
                    target: *target,
                    filter: filter.transpose()?.map(Box::new),
                })
            }
        })
    }
}
