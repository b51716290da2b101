//! What every learner does, and what it is told.

use crate::checkpoint::Contents;
use crate::config::AgentConfig;
use crate::learners::filter::form::WorldForm;
use anyhow::Result;
use emberwatch_belief::estimation::Estimator;
use emberwatch_belief::estimation::belief::Belief;

use crate::policy::Policy;
use crate::rollout::agent::{Agent, Chooser, Setup};
use crate::rollout::{Rollout, Seen};
use crate::update::{ModelUpdate, Tick};
use emberwatch_belief::planning::Target;
use emberwatch_messages::observation::Observation;
use emberwatch_model::{Airspace, Grid, Move, Shape};
use std::ops::Range;
use std::sync::Arc;
use std::time::Duration;

/// The robots to fly, as far as a learner is told.
#[derive(Debug, Clone)]
pub struct Worlds {
    /// Where robots may fly and what they see.
    pub airspace: Airspace,
    /// The zone of each cell, shape `[H, W]`, where land differs and learners are told.
    pub zones: Option<Arc<Grid<u8>>>,
    /// Number of values that an observed cell may show.
    pub n_observations: usize,
    pub n_moves: usize,
    pub numbers: Range<u32>,
}

impl Worlds {
    /// What beliefs must have been learned of.
    pub fn form(&self) -> WorldForm<'_> {
        WorldForm {
            n_observations: self.n_observations,
            n_matrices: self.airspace.n_rings(),
            zones: self.zones.as_deref(),
        }
    }

    pub fn shape(&self) -> Shape {
        self.airspace.shape()
    }

    /// One of them before it takes in what its world shows.
    pub(super) fn rollout(
        &self,
        config: &AgentConfig,
        policy: &Policy,
        estimator: Box<dyn Estimator>,
        state_names: Vec<String>,
        observation: Observation,
    ) -> Rollout {
        let objective = config.objective(policy);
        let setup = Setup {
            airspace: self.airspace.clone(),
            basis: config.objective.belief,
            beam_width: config.decisions.beam_width,
            state_names,
            n_moves: self.n_moves,
            seed: config.planner_seed(observation.world.seed),
            target: match objective.target {
                Target::State(state) => state,
                _ => 0,
            },
            chooser: Chooser::Objective(objective),
        };
        let agent = Agent::new(estimator, policy, config, setup);
        Rollout::new(agent, Seen::new([observation]))
    }
}

/// Which step of which run a robot saw, and from where: seed, episode, step k, row, column.
pub type Place = [u64; 5];

pub trait Learner {
    /// How its checkpoints call it.
    fn kind(&self) -> &'static str;

    /// Names of what its updates tell beside loss and rate.
    fn columns(&self) -> &'static [&'static str];

    /// Whether its next frames should show every cell, where the server gives such.
    fn wants_full_frames(&self) -> bool {
        false
    }

    /// Takes in what the robots see when it comes to them. Returns with how many of them it goes on where
    /// its checkpoint left it.
    fn attach(&mut self, observations: Vec<Observation>) -> Result<usize>;

    fn begin(&mut self, robot: u32, observation: Observation) -> Result<()>;

    /// The next path of each robot.
    fn plan(&mut self) -> Vec<Vec<Move>>;

    /// Takes in what the robots saw on these paths; their beliefs are then posteriors.
    fn see(&mut self, observations: Vec<Observation>) -> Result<Tick>;

    /// A robot's agent at its world, by its index.
    fn rollout(&self, index: usize) -> &Rollout;

    /// Moves the beliefs to the next step.
    fn predict(&mut self);

    /// Makes the updates that the steps since the last call have earned.
    fn learn(&mut self) -> Result<Vec<ModelUpdate>>;

    /// From here on it acts on what was learned, as well as it knows: without random actions.
    fn freeze(&mut self);

    /// World steps that were learned from, of all robots together.
    fn world_steps(&self) -> u64;

    fn n_updates(&self) -> u64;

    /// Why a run of that many steps made no update, and what to do.
    fn lacks(&self, steps: u64) -> String;

    /// What it predicts of its first world, and the state of that which it thinks pays most.
    fn belief(&self) -> Option<(&Belief, usize)>;

    /// What a later run goes on from.
    fn contents(&self) -> Result<Contents>;

    /// Time spent so far, by part.
    fn times(&self) -> Vec<(&'static str, Duration)>;
}

/// The cause where a run's steps have not earned an update. `name`: the setting.
pub(super) fn lacks_steps(name: &str, updates_per_step: f64) -> String {
    format!("too few for an update at {name} = {updates_per_step}; train for more --steps")
}

pub(super) fn place(observation: &Observation) -> Place {
    let (world, robot) = (&observation.world, &observation.robot);
    let [row, col] = [robot.row, robot.col].map(u64::from);
    [world.seed, world.episode, world.step, row, col]
}

/// Observations without hidden states, as learners get them.
pub(super) fn without_truth(observations: Vec<Observation>) -> Vec<Seen> {
    let seen = observations.into_iter();
    seen.map(|observation| Seen::new([observation])).collect()
}
