//! A belief that was learned, with all that estimators of it need.

use crate::estimation::NeuralEstimator;
use crate::learning::learners::filter::fit::LearnedModel;
use crate::learning::learners::neural::NeuralModel;
use emberwatch_belief::estimation::{BayesFilter, Estimator, correcting};
use emberwatch_network::NetworkError;
use emberwatch_protocol::Shape;

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
            Self::Filter(model) => {
                let filter = BayesFilter::learned(&model.tables, model.tables.prior(shape));
                let neighbours = || (model.target, model.correlations.clone());
                correcting(filter, is_spatial.then(neighbours))
            }
            Self::Neural(model) => Box::new(NeuralEstimator::new(&model.network, shape)?),
        })
    }
}
