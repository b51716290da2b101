//! What an agent is made of, as its policy wants it.

use super::{AgentError, Decider, Task};
use crate::config::AgentConfig;
use crate::estimator::truth::{Clairvoyant, Oracle, Unchanged};
use crate::estimator::{AutoencoderEstimator, BayesFilter, Estimator, EstimatorError};
use crate::learned::settings;
use crate::learner::LearnedModel;
use crate::planner::{BasisKind, PlanBasis};
use crate::policy::{EstimatorKind, Policy};
use crate::student::decisions::Decisions;
use protocol::Model;
use std::sync::Arc;

/// The model's names, or numbers where a learner called the states what it liked.
pub(super) fn state_names(kind: EstimatorKind, model: &Model, n_states: usize) -> Vec<String> {
    match kind {
        EstimatorKind::Learned | EstimatorKind::Autoencoder => numbered_states(n_states),
        _ => model.state_names(),
    }
}

/// Names of states that were learned.
pub fn numbered_states(n_states: usize) -> Vec<String> {
    (0..n_states)
        .map(|state| format!("state {state}"))
        .collect()
}

/// Where a policy's belief comes from, before the first frame. A new estimator is a line here.
pub(super) fn estimator(
    policy: &Policy,
    task: &Task<'_>,
) -> Result<Box<dyn Estimator>, AgentError> {
    let prior = task.prior.clone();
    Ok(match policy.estimator {
        EstimatorKind::None => Box::new(Unchanged(prior)),
        EstimatorKind::KnownModel => Box::new(BayesFilter::known(task.model, prior)?),
        EstimatorKind::Learned => Box::new(learned_filter(policy, task)?),
        EstimatorKind::Autoencoder => Box::new(autoencoder(policy, task)?),
        EstimatorKind::Truth => Box::new(Oracle::new(task.model, prior)?),
        EstimatorKind::NextTruth => Box::new(Clairvoyant(prior)),
    })
}

/// What a policy plans on: what the settings say, but where a DQN decides what it was trained with, as
/// its values are of such paths. Who is told the state that a path will meet plans on that.
pub(super) fn basis(
    policy: &Policy,
    task: &Task<'_>,
    config: &AgentConfig,
) -> Result<PlanBasis, AgentError> {
    let learned = task.learned;
    let kind = match policy.estimator {
        EstimatorKind::NextTruth => BasisKind::Predictor,
        EstimatorKind::Autoencoder if policy.is_decided => {
            present(policy, &learned.network, "an autoencoder")?.basis
        }
        _ if policy.is_decided => {
            let contents = present(policy, &learned.decisions, "decisions")?;
            settings(contents)?.objective.belief
        }
        _ => config.objective.belief,
    };
    Ok(PlanBasis::new(kind))
}

/// What decides for a policy: the DQN learned beside its belief, or that of a known model's.
pub(super) fn decider(
    policy: &Policy,
    task: &Task<'_>,
    config: &AgentConfig,
) -> Result<Decider, AgentError> {
    if policy.estimator != EstimatorKind::Autoencoder {
        let contents = present(policy, &task.learned.decisions, "decisions")?;
        let mut decisions = Decisions::first(task.model, &config.decisions, config.seed);
        decisions.load(contents)?;
        return Ok(Decider::Action(Arc::new(decisions)));
    }
    let network = present(policy, &task.learned.network, "an autoencoder")?.clone();
    let choices = Policy::network_choices(network.autoencoder.shape().n_states);
    let objectives = choices.iter().map(|choice| config.objective(choice));
    Ok(Decider::Objective {
        objectives: objectives.collect(),
        network,
    })
}

fn learned_filter(policy: &Policy, task: &Task<'_>) -> Result<BayesFilter, AgentError> {
    let learned: &LearnedModel = present(policy, &task.learned.filter, "a filter")?;
    same_observations(task, learned.tables.dimensions.n_observations)?;
    let prior = learned.tables.prior(task.shape);
    Ok(BayesFilter::learned(&learned.tables, prior))
}

fn autoencoder(policy: &Policy, task: &Task<'_>) -> Result<AutoencoderEstimator, AgentError> {
    let learned = present(policy, &task.learned.network, "an autoencoder")?;
    let shape = learned.autoencoder.shape();
    same_observations(task, shape.n_observations)?;
    if shape.grid != task.shape {
        let cells = |(height, width): (usize, usize)| format!("{height} x {width}");
        return Err(AgentError::OtherGrid {
            expected: cells(task.shape.dim()),
            got: cells(shape.grid.dim()),
        });
    }
    Ok(AutoencoderEstimator::new(&learned.autoencoder).map_err(EstimatorError::from)?)
}

fn present<'a, T>(
    policy: &Policy,
    learned: &'a Option<T>,
    kind: &'static str,
) -> Result<&'a T, AgentError> {
    learned.as_ref().ok_or_else(|| AgentError::NeedsCheckpoint {
        policy: policy.name.clone(),
        kind,
    })
}

fn same_observations(task: &Task<'_>, got: usize) -> Result<(), AgentError> {
    let expected = task.model.n_observations();
    match got == expected {
        true => Ok(()),
        false => Err(AgentError::OtherObservations { expected, got }),
    }
}
