//! Where a policy's agent is put together: estimator, planner, and what decides. A new estimator is a line here.

use crate::config::AgentConfig;
use crate::estimation::AutoencoderEstimator;
use crate::learned::Learned;
use crate::learners::decisions::LearnedDecisions;
use crate::learners::filter::form::WorldForm;
use crate::policy::{Choice, EstimatorKind, Policy, numbered_states};
use crate::rollout::agent::{Agent, Chooser, Decider, OptionChooser, Setup};
use anyhow::{Context, Result, ensure};
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::truth::{Clairvoyant, Oracle, Unchanging};
use emberwatch_belief::estimation::{BayesFilter, Correlations, Estimator, correcting};
use emberwatch_belief::planning::{BasisKind, Objective, Target};
use emberwatch_model::{Model, Shape};
use std::sync::Arc;

/// What a misfit is told of.
const CHECKPOINT: &str = "checkpoint";

#[derive(Debug, Clone, Copy)]
pub struct Task<'a> {
    /// The model, for filters and predictions.
    pub model: &'a Model,
    pub shape: Shape,
    pub n_moves: usize,
    pub prior: &'a Belief,
    /// Seed of the planner's random numbers: the agent's and the world's.
    pub seed: u64,
    /// What was learned, for policies that act on it.
    pub learned: &'a Learned,
}

/// A policy's agent, before its first frame.
pub fn agent(policy: &Policy, config: &AgentConfig, task: Task<'_>) -> Result<Agent> {
    let estimator = estimator(policy, &task)?;
    let state_names = match policy.estimator {
        kind if kind.is_learned() => numbered_states(estimator.belief().n_states()),
        _ => task.model.state_names(),
    };
    let learned_target = task.learned.target(policy.estimator);
    let mut objective = config.objective(policy);
    if let (Target::State(state), Some(target)) = (&mut objective.target, learned_target) {
        *state = target;
    }
    let setup = Setup {
        airspace: task.model.airspace(task.shape)?,
        chooser: chooser(policy, &task, config, objective)?,
        basis: basis(policy, &task, config)?,
        beam_width: match policy.choice {
            Choice::Scorer => decisions(policy, task.learned)?.beam_width,
            _ => config.decisions.beam_width,
        },
        state_names,
        n_moves: task.n_moves,
        seed: task.seed,
        target: learned_target.unwrap_or(task.model.target_state()),
    };
    Ok(Agent::new(estimator, policy, config, setup))
}

fn estimator(policy: &Policy, task: &Task<'_>) -> Result<Box<dyn Estimator>> {
    let prior = task.prior.clone();
    Ok(match policy.estimator {
        EstimatorKind::Known { is_spatial } => {
            let filter = BayesFilter::known(task.model, prior)?;
            let (state, nothing) = (task.model.target_state(), Correlations::default());
            correcting(filter, is_spatial.then_some((state, nothing)))
        }
        kind @ (EstimatorKind::Learned { .. } | EstimatorKind::Neural) => {
            let learned = present(policy, task.learned.belief(kind))?;
            learned.check_world(&world_form(task.model))?;
            let estimator = learned.estimator(kind.is_spatial(), task.shape);
            estimator.context(CHECKPOINT)?
        }
        EstimatorKind::Autoencoder => Box::new(autoencoder(policy, task)?),
        EstimatorKind::Truth => Box::new(Oracle::new(task.model, prior)?),
        EstimatorKind::NextTruth => Box::new(Clairvoyant(prior)),
        EstimatorKind::None => Box::new(Unchanging(prior)),
    })
}

/// What a policy plans on: what the settings say, but where a DQN decides what it was trained with, as
/// its values are of such paths. Who is told the state that a path will meet plans on that.
fn basis(policy: &Policy, task: &Task<'_>, config: &AgentConfig) -> Result<BasisKind> {
    let learned = task.learned;
    Ok(match policy.choice {
        Choice::Network => present(policy, learned.network.as_ref())?.basis,
        Choice::Scorer => decisions(policy, learned)?.basis,
        _ if policy.estimator == EstimatorKind::NextTruth => BasisKind::Predictor,
        _ => config.objective.belief,
    })
}

/// What says what each path is for; `objective`: the policy's own.
fn chooser(
    policy: &Policy,
    task: &Task<'_>,
    config: &AgentConfig,
    objective: Objective,
) -> Result<Chooser> {
    Ok(match policy.choice {
        Choice::Objective => Chooser::Objective(objective),
        Choice::Network => Chooser::Network(decider(policy, task, config)?),
        Choice::Option(option) => Chooser::Options(OptionChooser::Always(option)),
        Choice::Rule => Chooser::Options(OptionChooser::Rule),
        Choice::Scorer => {
            let scorer = decisions(policy, task.learned)?.scorer.clone();
            Chooser::Options(OptionChooser::Scorer(scorer))
        }
    })
}

/// The DQN learned beside an autoencoder.
fn decider(policy: &Policy, task: &Task<'_>, config: &AgentConfig) -> Result<Decider> {
    let network = present(policy, task.learned.network.as_ref())?.clone();
    let choices = Policy::network_choices(network.autoencoder.shape().n_states);
    let objectives: Vec<Objective> = choices.iter().map(|it| config.objective(it)).collect();
    Ok(Box::new(move |estimator| {
        let hidden = estimator.hidden();
        let hidden = hidden.expect("invariant: it decides for an autoencoder");
        objectives[network.dqn.best(hidden)]
    }))
}

/// The decisions that were learned on a policy's belief.
fn decisions<'a>(policy: &Policy, learned: &'a Learned) -> Result<&'a LearnedDecisions> {
    let decisions = present(policy, learned.decisions.as_ref())?;
    let [expected, got] = [policy.estimator, decisions.estimator].map(EstimatorKind::label);
    ensure!(
        got == expected,
        "checkpoint: expected decisions on the belief of {expected}, got some on that of {got}"
    );
    Ok(decisions)
}

fn autoencoder(policy: &Policy, task: &Task<'_>) -> Result<AutoencoderEstimator> {
    let learned = present(policy, task.learned.network.as_ref())?;
    let shape = learned.autoencoder.shape();
    world_form(task.model).check_observations(shape.n_observations, 1)?;
    ensure!(
        shape.grid == task.shape,
        "checkpoint: expected a network for {} cells as the world's, got one for {}",
        task.shape,
        shape.grid
    );
    AutoencoderEstimator::new(&learned.autoencoder).context(CHECKPOINT)
}

fn present<T>(policy: &Policy, learned: Option<T>) -> Result<T> {
    learned.with_context(|| needs_checkpoint(policy))
}

/// The words for a policy that was not given what was learned.
pub fn needs_checkpoint(policy: &Policy) -> String {
    let kind = match policy.estimator {
        estimator if policy.choice == Choice::Scorer => {
            &*format!("decisions on the belief of {}", estimator.label())
        }
        estimator if estimator.sees_own_state() => "a filter by own state (--learner own_filter)",
        EstimatorKind::Learned { .. } => "a filter",
        EstimatorKind::Neural => "a neural belief (--learner neural)",
        EstimatorKind::Autoencoder => "an autoencoder",
        _ => "decisions",
    };
    format!(
        "policy {:?} needs what `train` learned: expected --checkpoint FILE of {kind}",
        policy.name
    )
}

/// The words for a policy that filters with a model, on recorded worlds.
pub fn needs_model(policy: &Policy) -> String {
    format!(
        "policy {:?} filters with a model, and recorded worlds have none: expected --model FILE, or a policy that \
         needs none, such as coverage or learned_beam",
        policy.name
    )
}

/// What a world must have in common with that of a belief that was learned.
pub fn world_form(model: &Model) -> WorldForm<'_> {
    WorldForm {
        n_observations: model.n_observations(),
        n_matrices: model.n_rings(),
        zones: model.zone_map().map(Arc::as_ref),
    }
}

#[cfg(test)]
mod tests;
