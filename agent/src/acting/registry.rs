//! Where a policy's agent is put together: estimator, planner, and what decides. A new estimator is a line here.

use crate::config::AgentConfig;
use crate::estimation::belief::Belief;
use crate::estimation::truth::{Clairvoyant, Oracle, Unchanged};
use crate::estimation::{
    AutoencoderEstimator, BayesFilter, Correlations, Estimator, EstimatorError, SpatialFilter,
};
use crate::learning::checkpoint::Problem;
use crate::learning::learned::Learned;
use crate::learning::learner::LearnedModel;

use crate::learning::student::decisions::Decisions;
use crate::learning::student::network::LearnedNetwork;
use crate::planning::policy::{EstimatorKind, Policy};
use crate::planning::{BasisKind, Objective, PlanBasis};
use crate::rollout::agent::{Agent, AgentError, Choice, Decider, Setup, numbered_states};
use protocol::{Cell, Model, Shape};
use std::sync::Arc;

/// What an agent is built for.
#[derive(Debug, Clone, Copy)]
pub struct Task<'a> {
    /// The model, for filters and predictions.
    pub model: &'a Model,
    /// The grid.
    pub shape: Shape,
    /// Moves in a path.
    pub n_moves: usize,
    /// The belief before the first frame.
    pub prior: &'a Belief,
    /// Seed of the planner's random numbers: the agent's and the world's.
    pub seed: u64,
    /// What was learned, for policies that act on it.
    pub learned: &'a Learned,
}

/// A policy's agent, before its first frame.
///
/// # Errors
/// For a model that does not fit the grid, and where what the policy needs to have learned is missing or does
/// not fit the world.
pub fn agent(policy: &Policy, config: &AgentConfig, task: Task<'_>) -> Result<Agent, AgentError> {
    let estimator = estimator(policy, &task)?;
    let state_names = match policy.estimator {
        kind if kind.is_learned() => numbered_states(estimator.belief().n_states()),
        _ => task.model.state_names(),
    };
    let setup = Setup {
        basis: PlanBasis::new(basis(policy, &task, config)?),
        state_names,
        n_moves: task.n_moves,
        seed: task.seed,
    };
    let decider = policy
        .is_decided
        .then(|| decider(policy, &task, config))
        .transpose()?;
    let target = task.learned.target(policy.estimator);
    let agent = Agent::new(estimator, policy, config, setup);
    Ok(agent.with_target(target).with_decider(decider))
}

/// Where the belief comes from.
fn estimator(policy: &Policy, task: &Task<'_>) -> Result<Box<dyn Estimator>, AgentError> {
    let prior = task.prior.clone();
    Ok(match policy.estimator {
        EstimatorKind::None => Box::new(Unchanged(prior)),
        EstimatorKind::KnownModel => Box::new(BayesFilter::known(task.model, prior)?),
        EstimatorKind::Spatial => {
            let filter = BayesFilter::known(task.model, prior)?;
            let (state, nothing) = (task.model.target_state(), Correlations::default());
            Box::new(SpatialFilter::new(filter, state, nothing))
        }
        EstimatorKind::Learned => Box::new(learned_filter(policy, task)?),
        EstimatorKind::LearnedSpatial => {
            let filter = learned_filter(policy, task)?;
            let learned: &LearnedModel = present(policy, &task.learned.filter, "a filter")?;
            Box::new(SpatialFilter::new(
                filter,
                learned.target,
                learned.correlations.clone(),
            ))
        }
        EstimatorKind::Autoencoder => Box::new(autoencoder(policy, task)?),
        EstimatorKind::Truth => Box::new(Oracle::new(task.model, prior)?),
        EstimatorKind::NextTruth => Box::new(Clairvoyant(prior)),
    })
}

/// What a policy plans on: what the settings say, but where a DQN decides what it was trained with, as
/// its values are of such paths. Who is told the state that a path will meet plans on that.
fn basis(policy: &Policy, task: &Task<'_>, config: &AgentConfig) -> Result<BasisKind, AgentError> {
    let learned = task.learned;
    Ok(match policy.estimator {
        EstimatorKind::NextTruth => BasisKind::Predictor,
        EstimatorKind::Autoencoder if policy.is_decided => {
            present(policy, &learned.network, "an autoencoder")?.basis
        }
        _ if policy.is_decided => {
            let contents = present(policy, &learned.decisions, "decisions")?;
            contents.settings().map_err(unfit)?.objective.belief
        }
        _ => config.objective.belief,
    })
}

/// The DQN that chooses: the one learned beside the belief, or that of a known model's.
fn decider(
    policy: &Policy,
    task: &Task<'_>,
    config: &AgentConfig,
) -> Result<Box<dyn Decider>, AgentError> {
    if policy.estimator != EstimatorKind::Autoencoder {
        let contents = present(policy, &task.learned.decisions, "decisions")?;
        let mut decisions = Decisions::first(task.model, &config.decisions, config.seed);
        decisions.load(contents).map_err(unfit)?;
        return Ok(Box::new(decisions));
    }
    let network = present(policy, &task.learned.network, "an autoencoder")?.clone();
    let choices = Policy::network_choices(network.autoencoder.shape().n_states);
    let objectives = choices.iter().map(|choice| config.objective(choice));
    Ok(Box::new(NetworkDecider {
        objectives: objectives.collect(),
        network,
    }))
}

/// The DQN of Algorithm 1.
struct NetworkDecider {
    network: Arc<LearnedNetwork>,
    objectives: Vec<Objective>,
}

impl Decider for NetworkDecider {
    fn decide(&self, estimator: &dyn Estimator, robot: Cell, n_moves: usize) -> Choice {
        let follower = estimator.follower();
        let follower = follower.expect("invariant: it decides for an autoencoder");
        let input = self.network.input.of(follower, robot, n_moves);
        Choice::Objective(self.objectives[self.network.dqn.best(&input)])
    }
}

impl Decider for Decisions {
    fn decide(&self, estimator: &dyn Estimator, robot: Cell, n_moves: usize) -> Choice {
        let action = self.best_action(estimator.belief(), robot, n_moves);
        Choice::Action(action.clone())
    }
}

fn unfit(problem: Problem) -> AgentError {
    AgentError::Checkpoint(problem.to_string())
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

#[cfg(test)]
mod tests;
