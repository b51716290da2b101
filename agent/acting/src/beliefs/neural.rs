//! The neural belief: an estimator whose network predicts the next observation of each cell.
//!
//! The network reads each cell's last observation and its age. It can also read a filter's prediction and correct it.
//!
//! The belief is about observations instead of states, so S = O. After a frame, the observations of visited cells have
//! probability 1.

use super::kind::{BeliefKind, Input, LearnedBelief, LearnedBy, Traits, cast_mut};
use super::learned::{LEARNED, LearnedModel};
use super::world_form::WorldForm;
use crate::parallel::in_parallel;
use anyhow::{Context, Result};
use emberwatch_belief::estimation::bayes::{check as check_evidence, correct, observations};
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::estimator::{
    Estimator, EstimatorError, Filter, Handover, ObservationModel,
};
use emberwatch_model::grid::Probabilities;
use emberwatch_model::{Frame, Shape};
use emberwatch_network::{NetworkError, NeuralBelief, Sightings};
use ndarray::Array2;
use std::borrow::Cow;

pub const NEURAL: BeliefKind = BeliefKind {
    name: "neural",
    about: "a learned network that predicts observations from the last ones",
    input: Input::Frames,
    knows_model: false,
    has_options: true,
    is_of_observations: true,
    is_parallel: true,
    learned_by: Some(LearnedBy {
        learner: "neural",
        decides: false,
        find: |learned| learned.get::<NeuralModel>().map(|model| model as _),
    }),
    chart: LEARNED.chart,
    traits: Traits {
        predict_together: Some(predict_together),
        ..Traits::of_filter::<NeuralEstimator>()
    },
    build: |conditions| {
        let model = conditions.learned.get::<NeuralModel>();
        let model = model.context("checkpoint: expected a learned neural belief, got none")?;
        let estimator = model.estimator(conditions.shape);
        Ok(Box::new(estimator.context("checkpoint")?))
    },
};

/// A learned neural belief: everything that an agent needs to act on it.
#[derive(Clone)]
pub struct NeuralModel {
    pub network: NeuralBelief,
    /// The filter whose prediction the network corrects, if any.
    pub filter: Option<Box<LearnedModel>>,
    /// The observation with the highest reward.
    pub target: usize,
}

impl PartialEq for NeuralModel {
    fn eq(&self, other: &Self) -> bool {
        let parameters = |model: &Self| model.network.parameters().ok();
        self.target == other.target
            && self.filter == other.filter
            && parameters(self) == parameters(other)
    }
}

impl NeuralModel {
    /// Builds an estimator before its first frame.
    pub fn estimator(&self, shape: Shape) -> Result<NeuralEstimator> {
        estimator(&self.network, self.filter.as_deref(), shape)
    }
}

impl LearnedBelief for NeuralModel {
    fn kind(&self) -> &'static BeliefKind {
        &NEURAL
    }

    fn target(&self) -> usize {
        self.target
    }

    fn n_states(&self) -> usize {
        self.network.n_observations()
    }

    fn check_world(&self, world: &WorldForm) -> Result<()> {
        world.check_observations(self.network.n_observations())?;
        let mut filters = self.filter.iter();
        filters.try_for_each(|filter| filter.check_world(world))
    }
}

/// Builds an estimator. Corrections of the filter, if there is one, reach the neighbours of visited cells.
pub fn estimator(
    network: &NeuralBelief,
    filter: Option<&LearnedModel>,
    shape: Shape,
) -> Result<NeuralEstimator> {
    let filter = filter.map(|it| it.estimator(true, shape));
    Ok(NeuralEstimator::new(network, filter, shape)?)
}

/// The neural belief of one world.
pub struct NeuralEstimator {
    network: NeuralBelief,
    filter: Option<Box<dyn Filter>>,
    /// The distribution over observations that the filter predicts, shape `[O, H, W]`.
    base: Option<Probabilities>,
    sightings: Sightings,
    belief: Belief,
    /// The identity, because the belief is about observations.
    likelihood: Array2<f64>,
    failure: Option<NetworkError>,
}

impl NeuralEstimator {
    /// Creates the belief before the first frame. `filter` is required if the network was trained to correct one.
    pub fn new(
        network: &NeuralBelief,
        filter: Option<Box<dyn Filter>>,
        shape: Shape,
    ) -> Result<Self, NetworkError> {
        let sightings = Sightings::new(shape);
        let base = filter.as_deref().and_then(predicted_observations);
        Ok(Self {
            belief: belief(network.predict(&sightings, base.as_ref())?),
            network: network.clone(),
            filter,
            base,
            sightings,
            likelihood: Array2::eye(network.n_observations()),
            failure: None,
        })
    }

    /// Returns the distribution of each cell's next observation, shape `[O, H, W]`, as predicted by the refined filter.
    pub fn base(&self) -> Option<&Probabilities> {
        self.base.as_ref()
    }
}

impl Estimator for NeuralEstimator {
    /// # Errors
    /// If the frame is impossible under this belief or the filter's, or the last prediction failed. Neither belief
    /// changes; after a failure, all frames are refused until a prediction succeeds.
    fn correct(&mut self, frame: &Frame) -> Result<(), EstimatorError> {
        if let Some(failure) = &self.failure {
            return Err(EstimatorError::Network(failure.clone().into()));
        }
        check_evidence(&self.belief, &self.likelihood, frame)?;
        if let Some(filter) = &mut self.filter {
            filter.correct(frame)?;
        }
        correct(&mut self.belief, &self.likelihood, frame)?;
        self.sightings.see(frame);
        Ok(())
    }

    fn predict(&mut self) {
        predict_together(vec![self]);
    }

    fn belief(&self) -> &Belief {
        &self.belief
    }
}

impl ObservationModel for NeuralEstimator {
    fn likelihood(&self) -> Option<Cow<'_, Array2<f64>>> {
        Some(Cow::Borrowed(&self.likelihood))
    }
}

impl Handover for NeuralEstimator {
    fn kind(&self) -> String {
        let numbers = self.network.parameters().unwrap_or_default();
        let numbers = numbers.iter().flat_map(|(_, _, numbers)| numbers);
        let bytes: Vec<u8> = numbers.flat_map(|number| number.to_le_bytes()).collect();
        let checksum = crc32fast::hash(&bytes);
        let filter = self.filter.as_ref();
        let filter = filter.map_or(String::new(), |it| format!(" on {}", it.kind()));
        format!("neural_belief {checksum:08x}, probabilities [O, H, W] as f32, sightings{filter}")
    }

    fn to_bytes(&self) -> Vec<u8> {
        if self.failure.is_some() {
            return Vec::new();
        }
        let filter = self.filter.as_ref().map_or(Vec::new(), |it| it.to_bytes());
        [self.belief.to_bytes(), self.sightings.to_bytes(), filter].concat()
    }

    fn restore(&mut self, bytes: &[u8]) -> bool {
        let dim = self.belief.probabilities().dim();
        let n_bytes = 4 * self.belief.as_slice().len();
        let Some((belief, rest)) = bytes.split_at_checked(n_bytes) else {
            return false;
        };
        let n_bytes = self.sightings.to_bytes().len();
        let Some((sightings, rest)) = rest.split_at_checked(n_bytes) else {
            return false;
        };
        let belief = Belief::from_bytes(belief, dim);
        let sightings = Sightings::from_bytes(sightings, self.sightings.shape(), dim.0);
        let Some((belief, sightings)) = belief.zip(sightings) else {
            return false;
        };
        let filter = self.filter.as_mut();
        if !filter.map_or(rest.is_empty(), |filter| filter.restore(rest)) {
            return false;
        }
        self.base = self.filter.as_deref().and_then(predicted_observations);
        (self.belief, self.sightings, self.failure) = (belief, sightings, None);
        true
    }
}

/// Runs the predictions of several estimators. Worlds with the same network and grid share one forward pass.
fn predict_together(estimators: Vec<&mut dyn Estimator>) {
    let networks = estimators.into_iter().map(cast_mut::<NeuralEstimator>);
    let mut networks: Vec<&mut NeuralEstimator> = networks.collect();
    in_parallel(networks.iter_mut(), |it| it.advance());
    networks.sort_by_key(|it| it.pass_key());
    for group in networks.chunk_by_mut(|a, b| a.pass_key() == b.pass_key()) {
        NeuralEstimator::predict_all(group);
    }
}

impl NeuralEstimator {
    fn advance(&mut self) {
        self.sightings.pass();
        if let Some(filter) = &mut self.filter {
            filter.predict();
            self.base = predicted_observations(&**filter);
        }
    }

    fn pass_key(&self) -> (usize, [usize; 2], bool) {
        let (height, width) = self.sightings.shape().dim();
        (self.network.id(), [height, width], self.base.is_some())
    }

    /// Runs the predictions for one group of worlds. A failure is recorded in every estimator of the group.
    fn predict_all(all: &mut [&mut Self]) {
        let worlds = all.iter().map(|it| (&it.sightings, it.base.as_ref()));
        let predicted = all[0].network.predict_all(&worlds.collect::<Vec<_>>());
        match predicted {
            Ok(predicted) => {
                for (estimator, probabilities) in all.iter_mut().zip(predicted) {
                    (estimator.belief, estimator.failure) = (belief(probabilities), None);
                }
            }
            Err(failure) => {
                for estimator in all {
                    estimator.failure = Some(failure.clone());
                }
            }
        }
    }
}

fn belief(probabilities: Probabilities) -> Belief {
    let belief = Belief::from_probabilities(probabilities);
    belief.expect("invariant: a softmax is on the simplex")
}

/// Returns the distribution of each cell's next observation, `[O, H, W]`, under a belief about X_{k+1}.
fn predicted_observations(estimator: &dyn Filter) -> Option<Probabilities> {
    let likelihood = estimator.likelihood()?;
    Some(observations(estimator.belief(), &likelihood))
}

#[cfg(test)]
mod tests;
