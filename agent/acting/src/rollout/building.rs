//! Builds a policy's agent from its belief, its planner and its chooser.

use super::agent::{Agent, Chooser, Decider, Setup};
use crate::beliefs::autoencoder::{AutoencoderEstimator, AutoencoderModel};
use crate::beliefs::{Conditions, WorldForm, cast};
use crate::config::AgentConfig;
use crate::learned::Learned;
use crate::policy::{BY_OPTIONS, Goal, Policy, network_choices};
use anyhow::{Context, Result};
use emberwatch_belief::planning::Objective;

/// Checks that a policy can act in worlds of the given form with the given checkpoints.
///
/// # Errors
/// If the checkpoints lack something that the policy uses, or were trained in worlds of another form.
pub fn check(policy: &Policy, learned: &Learned, world: &WorldForm) -> Result<()> {
    policy.check(learned)?;
    policy.belief.check(learned, world)
}

/// Builds a policy's agent before its first frame. `seed` is the planner's seed, see [`AgentConfig::planner_seed`].
///
/// # Errors
/// If [`check`] fails, or the network's computation fails.
pub fn agent(
    policy: &Policy,
    config: &AgentConfig,
    conditions: &Conditions<'_>,
    n_moves: usize,
    seed: u64,
) -> Result<Agent> {
    let (belief, learned) = (policy.belief, conditions.learned);
    let (model, shape) = (conditions.model()?, conditions.shape);
    check(policy, learned, &WorldForm::of(model, shape))?;
    let estimator = (belief.build)(conditions)?;
    let target = belief.target(conditions)?;
    let setup = Setup {
        airspace: model.airspace(shape)?,
        chooser: chooser(policy, learned, target)?,
        beam_width: if policy.chooses_options() {
            policy.decisions(learned)?.beam_width
        } else {
            config.decisions.beam_width
        },
        state_names: belief.state_names(conditions)?,
        n_moves,
        seed,
        target,
    };
    Ok(Agent::new(estimator, policy, config, setup))
}

fn chooser(policy: &Policy, learned: &Learned, target: usize) -> Result<Chooser> {
    if *policy.planner == BY_OPTIONS {
        return Ok(match policy.goal {
            Goal::Option(option) => Chooser::Option(option),
            Goal::Learned => Chooser::Scorer(policy.decisions(learned)?.scorer.clone()),
            _ => Chooser::Rule,
        });
    }
    Ok(match policy.goal {
        Goal::Learned => {
            let network = learned.get::<AutoencoderModel>();
            let missing = "checkpoint: expected a learned autoencoder, got none";
            Chooser::Network(decider(network.context(missing)?))
        }
        _ => Chooser::Objective(policy.objective(target)),
    })
}

fn decider(network: &AutoencoderModel) -> Decider {
    let choices = network_choices(network.autoencoder.shape().n_states).into_iter();
    let objectives = choices.map(|choice| choice.objective(network.target));
    let objectives: Vec<Objective> = objectives.collect();
    let dqn = network.dqn.clone();
    Box::new(move |estimator| {
        let hidden = cast::<AutoencoderEstimator>(estimator).hidden();
        objectives[dqn.best(hidden)]
    })
}

#[cfg(test)]
mod tests;
