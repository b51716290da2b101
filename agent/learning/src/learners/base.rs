//! What every learner does, and what it is told.

use super::update::ModelUpdate;
use crate::beliefs::WorldForm;
use crate::checkpoint::Contents;
use crate::config::AgentConfig;
use crate::learned::Learned;
use crate::policy::Policy;
use crate::rollout::agent::{Agent, Chooser, Setup};
use crate::rollout::{Actor, Rollout, Seen};
use anyhow::{Result, ensure};
use emberwatch_belief::estimation::Estimator;
use emberwatch_messages::control::ServerInfo;
use emberwatch_messages::observation::Observation;
use emberwatch_model::{Airspace, Shape};
use emberwatch_network::Device;
use std::fmt;
use std::ops::Range;

/// A kind of learner: its constructor, and the facts that commands ask for.
pub struct LearnerKind {
    /// Its name: `train --learner NAME`.
    pub name: &'static str,
    /// What it learns, in a few words.
    pub about: &'static str,
    /// How its checkpoints call it: first as it writes them, then as earlier releases did.
    pub checkpoints: &'static [&'static str],
    /// Names of the numbers of its updates beside loss and rate.
    pub columns: &'static [&'static str],
    /// Whether it follows one robot of one world alone.
    pub is_single: bool,
    /// World steps of a whole training under these settings; 0: until stopped.
    pub steps: fn(&AgentConfig) -> u64,
    /// Steps of an episode of a server that is started for it; `None`: without end.
    pub episode_steps: fn(&AgentConfig) -> Option<u64>,
    /// World steps that a checkpoint has learned from.
    pub done: fn(&Contents) -> Result<u64>,
    /// Sets what a checkpoint decides in the settings of a run that resumes it.
    pub adopt: fn(&Contents, &mut AgentConfig),
    /// Reads what policies act on from a checkpoint; returns whether there was another before.
    pub read: fn(&Contents, &Device, &mut Learned) -> Result<bool>,
    /// Begins to learn, or goes on from a checkpoint.
    pub begin: fn(Beginning<'_>) -> Result<Box<dyn Learner>>,
}

impl PartialEq for LearnerKind {
    fn eq(&self, other: &Self) -> bool {
        self.name == other.name
    }
}

impl fmt::Debug for LearnerKind {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.name)
    }
}

/// What a learner begins with.
#[derive(Clone)]
pub struct Beginning<'a> {
    pub worlds: Worlds,
    /// What the server says of itself.
    pub info: &'a ServerInfo,
    pub config: &'a AgentConfig,
    /// Of the checkpoint to go on from, if there is one.
    pub contents: Option<&'a Contents>,
    /// What was learned before, for learners that build on it.
    pub learned: &'a Learned,
    /// Where networks compute.
    pub device: &'a Device,
    /// Whether it only acts.
    pub is_frozen: bool,
}

/// The robots to fly, as far as a learner is told.
#[derive(Debug, Clone)]
pub struct Worlds {
    /// Where robots may fly and what they see.
    pub airspace: Airspace,
    /// Number of values that an observed cell may show.
    pub n_observations: usize,
    pub n_moves: usize,
    /// The numbers of the robots on the server.
    pub numbers: Range<u32>,
}

impl Worlds {
    /// What beliefs must have been learned of.
    pub fn form(&self) -> WorldForm {
        WorldForm {
            shape: self.shape(),
            n_observations: self.n_observations,
            n_matrices: self.airspace.n_rings(),
        }
    }

    pub fn shape(&self) -> Shape {
        self.airspace.shape()
    }

    /// Refuses a sensor with several observation matrices, for networks.
    pub(super) fn check_matrices(&self) -> Result<()> {
        let n_rings = self.airspace.n_rings();
        ensure!(
            n_rings == 1,
            "learner: expected a sensor with one observation matrix, as networks learn such alone, got {n_rings}"
        );
        Ok(())
    }

    /// A robot before it takes in what its world shows. `target`: what its belief calls the state that pays most.
    pub(super) fn rollout(
        &self,
        config: &AgentConfig,
        (policy, target): (&Policy, usize),
        estimator: Box<dyn Estimator>,
        state_names: Vec<String>,
        observation: Observation,
    ) -> Rollout {
        let setup = Setup {
            airspace: self.airspace.clone(),
            basis: config.objective.belief,
            beam_width: config.decisions.beam_width,
            state_names,
            n_moves: self.n_moves,
            seed: config.planner_seed(observation.world.seed),
            target,
            chooser: Chooser::Objective(policy.objective(target, config)),
        };
        let agent = Agent::new(estimator, policy, config, setup);
        Rollout::new(agent, Seen::new([observation]))
    }
}

/// Which step of which run a robot saw, and from where: seed, episode, step k, row, column.
pub type Place = [u64; 5];

/// What acts on several robots and learns from what they see.
pub trait Learning: Actor {
    /// Whether its next frames should show every cell, where the server gives such.
    fn wants_full_frames(&self) -> bool {
        false
    }

    /// Begins another episode of a robot.
    fn begin(&mut self, robot: u32, observation: Observation) -> Result<()>;

    /// Makes the updates that the steps since the last call have earned.
    fn learn(&mut self) -> Result<Vec<ModelUpdate>>;

    /// From here on it acts on what was learned, as well as it knows: without random actions.
    fn freeze(&mut self);

    /// A robot's agent at its world, by its index.
    fn rollout(&self, index: usize) -> &Rollout;

    /// The state that it thinks pays most.
    fn target(&self) -> usize;

    /// World steps that were learned from, of all robots together.
    fn world_steps(&self) -> u64;

    fn n_updates(&self) -> u64;

    /// Why a run of that many steps made no update, and what to do.
    fn lacks(&self, steps: u64) -> String;
}

/// What is kept of a learner between runs.
pub trait Saving {
    /// Takes in what the robots see when it comes to them. Returns with how many of them it goes on where its checkpoint
    /// left it.
    fn attach(&mut self, observations: Vec<Observation>) -> Result<usize>;

    /// What a later run goes on from.
    fn contents(&self) -> Result<Contents>;
}

/// What `train` drives: it acts, learns, and is saved.
pub trait Learner: Learning + Saving {}

impl<L: Learning + Saving> Learner for L {}

/// The cause where a run's steps have not earned an update. `name`: the setting.
pub(super) fn lacks_steps(name: &str, updates_per_step: f64) -> String {
    format!("too few for an update at {name} = {updates_per_step}; train for more --steps")
}

pub(super) fn place(observation: &Observation) -> Place {
    let (world, robot) = (&observation.world, &observation.robot);
    let [row, col] = [robot.row, robot.col].map(u64::from);
    [world.seed, world.episode, world.step, row, col]
}
