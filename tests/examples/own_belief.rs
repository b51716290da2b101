//! Example of a custom estimator. A policy based on it acts on worlds in this process and is compared with policies of
//! the benchmark.
//!
//! The estimator assumes that each cell is still in the state last observed there, with a confidence that decreases
//! each step. Run it with `cargo run --release -p tests --example own_belief`.

use anyhow::Result;
use emberwatch_acting::beliefs::{BeliefKind, Conditions, Input, Traits};
use emberwatch_acting::config::AgentConfig;
use emberwatch_acting::learned::Learned;
use emberwatch_acting::policy::{BEAM, Goal, Policy};
use emberwatch_acting::rollout::{ActingAgent, building, step};
use emberwatch_acting::served::Served;
use emberwatch_belief::Belief;
use emberwatch_belief::estimation::bayes::correct;
use emberwatch_belief::estimation::{Estimator, EstimatorError};
use emberwatch_protocol::client::{Claim, Client};
use emberwatch_protocol::settings::WorldSettings;
use emberwatch_protocol::{Frame, Model};
use emberwatch_sim::config::ServerConfig;
use emberwatch_sim::embedded::Embedded;
use ndarray::Array2;

/// Factor by which the confidence in an observation decreases per step.
const KEPT: f32 = 0.95;

const WORLDS: u32 = 4;
const STEPS: u64 = 100;

/// An estimator whose belief about a cell is based on the last observation there and then decays to the initial belief.
struct LastSeen {
    belief: Belief,
    first: Belief,
    likelihood: Array2<f64>,
}

/// The description and the constructor of this estimator, for a policy.
const LAST_SEEN: BeliefKind = BeliefKind {
    name: "last_seen",
    about: "the last observation of each cell, less certain with each step",
    input: Input::Frames,
    knows_model: true,
    has_options: false,
    is_of_observations: false,
    is_parallel: false,
    learned_by: None,
    chart: ("last seen", [0x88, 0x22, 0x55]),
    traits: Traits::NONE,
    build: |conditions| {
        let first = conditions.prior()?;
        Ok(Box::new(LastSeen {
            belief: first.clone(),
            first,
            likelihood: conditions.model()?.likelihood().clone(),
        }))
    },
};

impl Estimator for LastSeen {
    fn correct(&mut self, frame: &Frame) -> Result<(), EstimatorError> {
        Ok(correct(&mut self.belief, &self.likelihood, frame)?)
    }

    fn predict(&mut self) {
        let faded = self.belief.probabilities() * KEPT + self.first.probabilities() * (1.0 - KEPT);
        self.belief = Belief::from_probabilities(faded).expect("a mean of two beliefs");
    }

    fn belief(&self) -> &Belief {
        &self.belief
    }
}

#[expect(clippy::print_stdout, reason = "an example")]
fn main() -> Result<()> {
    let model = Model::wildfire();
    let mut policies = vec![Policy::new(&LAST_SEEN, &BEAM, Goal::Exploit, &model)];
    for name in ["random_walk", "coverage", "beam"] {
        policies.push(Policy::named(name, &model)?);
    }
    for policy in policies {
        println!("{:24} {:.2}", policy.name, mean_reward(&policy, &model)?);
    }
    Ok(())
}

/// Returns the mean reward per step of a policy. Every policy acts on the same worlds.
fn mean_reward(policy: &Policy, model: &Model) -> Result<f64> {
    let settings = ServerConfig {
        worlds: WORLDS,
        seed: 1000,
        world: WorldSettings {
            height: 32,
            width: 32,
            moves: 32,
            burn_in: 5000,
            ..WorldSettings::default()
        },
        ..ServerConfig::default()
    };
    let mut client = Client::acquire(Embedded::new(settings.check()?)?, &Claim::new(0..WORLDS))?;
    let (config, shape, n_moves) = (
        AgentConfig::default(),
        client.shape(),
        client.info().n_moves,
    );
    let conditions = Conditions {
        shape,
        model: Some(model),
        prior: Some(&Belief::uniform(model.n_states(), shape)),
        learned: &Learned::default(),
    };
    let mut agents = Vec::new();
    for seen in Served::new(&mut client, false).observe()? {
        let seed = config.planner_seed(seen.observation.world.seed);
        let agent = building::agent(policy, &config, &conditions, n_moves, seed)?;
        agents.push(ActingAgent::begun(agent, seen)?);
    }
    let mut sum = 0.0;
    for _ in 0..STEPS {
        let records = step(&mut agents, &mut Served::new(&mut client, false))?;
        sum += records.iter().flatten().map(|it| it.reward).sum::<f64>();
    }
    Ok(sum / (STEPS * u64::from(WORLDS)) as f64)
}
