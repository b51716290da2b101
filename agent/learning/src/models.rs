//! Learned models in checkpoints: the filter, and the neural belief with the filter that it may correct.

use crate::checkpoint::{Part, check, wrong};
use crate::reward::RewardEstimate;
use anyhow::Result;
use emberwatch_acting::beliefs::learned::LearnedModel;
use emberwatch_acting::beliefs::neural::NeuralModel;
use emberwatch_belief::estimation::Correlations;
use emberwatch_belief::estimation::parameters::{Dimensions, Parameters};
use emberwatch_model::MAX_VALUES;
use emberwatch_network::{Device, NamedTensor, NetworkError, NeuralBelief};
use serde::{Deserialize, Serialize};

const FILTER: &str = "filter.";

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

/// The part of a [`NeuralModel`] that a checkpoint stores besides the tensors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SavedNeuralModel {
    n_observations: usize,
    target: usize,
    filter: Option<Box<SavedModel>>,
}

impl SavedNeuralModel {
    /// Extracts the stored part of a model.
    pub fn of(model: &NeuralModel) -> Self {
        let filter = model.filter.as_deref();
        Self {
            n_observations: model.network.n_observations(),
            target: model.target,
            filter: filter.map(|it| Box::new(SavedModel::of(it))),
        }
    }

    /// Returns the number of observations.
    pub fn n_observations(&self) -> usize {
        self.n_observations
    }

    /// Loads the model, with its tensors from a part of a checkpoint. The network computes on `device`.
    pub fn read(&self, part: &Part<'_>, device: &Device) -> Result<NeuralModel> {
        let n_observations = self.n_observations;
        let (fits, expected) = (1..=MAX_VALUES, format!("1 to {MAX_VALUES}"));
        let fits = fits.contains(&n_observations);
        check(fits, "n_observations", expected, n_observations)?;
        check_target(self.target, n_observations)?;
        let mut network = NeuralBelief::new(n_observations, 0, device)?;
        network.set_parameters(|name: &str, shape: &[usize]| part.tensor(name, shape))?;
        Ok(NeuralModel {
            network,
            filter: self.read_filter(part)?,
            target: self.target,
        })
    }

    /// Loads the corrected filter, if there is one.
    pub fn read_filter(&self, part: &Part<'_>) -> Result<Option<Box<LearnedModel>>> {
        let Some(filter) = &self.filter else {
            return Ok(None);
        };
        let (expected, got) = (self.n_observations, filter.n_observations());
        check(got == expected, "filter.n_observations", expected, got)?;
        Ok(Some(Box::new(filter.read(&part.part(FILTER))?)))
    }
}

/// What a checkpoint of a learned belief stores besides its tensors. `M` is its model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SavedBeliefLearner<M> {
    pub model: M,
    pub reward: RewardEstimate,
    pub n_updates: u64,
    /// Number of world steps, for all worlds together.
    pub world_steps: u64,
}

pub type SavedFilter = SavedBeliefLearner<SavedModel>;

pub type SavedNeural = SavedBeliefLearner<SavedNeuralModel>;

/// Returns the parameters of a filter as named tensors.
pub fn filter_tensors(model: &LearnedModel) -> [NamedTensor; 3] {
    named_tensors(&model.parameters, "")
}

/// Returns the parameters of a network, and of the filter that it corrects, as named tensors.
///
/// # Errors
/// If the network's device fails.
pub fn neural_tensors(model: &NeuralModel) -> Result<Vec<NamedTensor>, NetworkError> {
    let filter = model.filter.as_deref().map(corrected_tensors);
    let parameters = model.network.parameters()?.into_iter();
    Ok(parameters.chain(filter.into_iter().flatten()).collect())
}

/// Returns the tensors of a corrected filter, with the prefix `filter.`.
pub fn corrected_tensors(filter: &LearnedModel) -> impl Iterator<Item = NamedTensor> + use<> {
    let named = |(name, shape, numbers)| (format!("{FILTER}{name}"), shape, numbers);
    filter_tensors(filter).into_iter().map(named)
}

fn check_target(target: usize, n_states: usize) -> Result<()> {
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
