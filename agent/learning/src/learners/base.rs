//! The interface of all learners, and their inputs.

use super::update::ModelUpdate;
use crate::checkpoint::Contents;
use anyhow::Result;
use emberwatch_acting::beliefs::{BeliefKind, WorldForm};
use emberwatch_acting::config::AgentConfig;
use emberwatch_acting::learned::Learned;
use emberwatch_acting::policy::Policy;
use emberwatch_acting::rollout::agent::{Agent, Chooser, Setup};
use emberwatch_acting::rollout::{ActingAgent, Actor, AgentObservation};
use emberwatch_belief::estimation::Estimator;
use emberwatch_messages::control::ServerInfo;
use emberwatch_messages::observation::Observation;
use emberwatch_model::{Airspace, Shape};
use emberwatch_network::Device;
use std::fmt;
use std::ops::Range;

/// A kind of learner: its constructor, and the properties that commands need.
pub struct LearnerKind {
    /// Name, as in `train --learner NAME`.
    pub name: &'static str,
    /// Short description of the result.
    pub about: &'static str,
    /// Name of the learner's kind of checkpoint.
    pub checkpoint: &'static str,
    /// Names of the values that its updates report besides loss and step size.
    pub columns: &'static [&'static str],
    /// Whether it supports only a single robot in a single world.
    pub is_single: bool,
    /// The flags of `train` that apply to it and not to every learner, without `--`.
    pub flags: &'static [&'static str],
    /// Returns the belief that it builds on, if any.
    pub base: fn(&AgentConfig) -> Result<Option<&'static BeliefKind>>,
    /// Whether it needs a base.
    pub needs_base: bool,
    /// Returns the default number of world steps of a training run. 0 means that it runs until stopped.
    pub steps: fn(&AgentConfig) -> u64,
    /// Returns the number of steps per episode in worlds that `train` simulates. `None` means endless episodes.
    pub episode_steps: fn(&AgentConfig) -> Option<u64>,
    /// Returns the number of world steps that the learner of a checkpoint has learned from.
    pub done: fn(&Contents) -> Result<u64>,
    /// When a run resumes a checkpoint, copies the settings that the checkpoint determines into the run's settings.
    pub adopt: fn(&Contents, &mut AgentConfig) -> Result<()>,
    /// Loads from a checkpoint the values that policies use. Returns whether it replaced a different value.
    pub read: fn(&Contents, &Device, &mut Learned) -> Result<bool>,
    /// Creates a learner, or resumes one from a checkpoint.
    pub build: fn(LearnerInputs<'_>) -> Result<Box<dyn Learner>>,
}

impl PartialEq for LearnerKind {
    fn eq(&self, other: &Self) -> bool {
        self.name == other.name
    }
}

impl LearnerKind {
    /// Returns the default number of worlds of a training.
    pub fn n_worlds(&self) -> u32 {
        if self.is_single { 1 } else { 16 }
    }

    /// Returns the number of world steps of a training that another one or a suite needs. 0 means that there is none.
    pub fn full_steps(&self, config: &AgentConfig) -> u64 {
        match (self.steps)(config) {
            0 if !self.is_single => config.decisions.filter_steps,
            steps => steps,
        }
    }
}

impl fmt::Debug for LearnerKind {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.name)
    }
}

/// The inputs for creating a learner.
#[derive(Clone)]
pub struct LearnerInputs<'a> {
    pub worlds: Worlds,
    /// The server's description of itself.
    pub info: &'a ServerInfo,
    pub config: &'a AgentConfig,
    /// The checkpoint to resume from, if any.
    pub contents: Option<&'a Contents>,
    /// Previously learned values, for learners that build on them.
    pub learned: &'a Learned,
    /// The device on which networks compute.
    pub device: &'a Device,
}

/// The learner's knowledge of its worlds and robots.
#[derive(Debug, Clone)]
pub struct Worlds {
    /// The cells that robots may fly over, and the range of their sensors.
    pub airspace: Airspace,
    /// Number of observation values.
    pub n_observations: usize,
    pub n_moves: usize,
    /// The robots' numbers on the server.
    pub numbers: Range<u32>,
}

impl Worlds {
    /// Returns the form of the worlds, which learned beliefs must match.
    pub fn form(&self) -> WorldForm {
        WorldForm {
            shape: self.shape(),
            n_observations: self.n_observations,
        }
    }

    pub fn shape(&self) -> Shape {
        self.airspace.shape()
    }

    pub(super) fn new_agent(
        &self,
        config: &AgentConfig,
        (policy, target): (&Policy, usize),
        estimator: Box<dyn Estimator>,
        state_names: Vec<String>,
        observation: Observation,
    ) -> Result<ActingAgent> {
        let setup = Setup {
            airspace: self.airspace.clone(),
            beam_width: config.decisions.beam_width,
            state_names,
            n_moves: self.n_moves,
            seed: config.planner_seed(observation.world.seed),
            target,
            chooser: Chooser::Objective(policy.objective(target)),
        };
        let agent = Agent::new(estimator, policy, config, setup);
        ActingAgent::begun(agent, AgentObservation::new([observation]))
    }
}

/// A learner for `train`: an actor that learns from the observations of its robots.
pub trait Learner: Actor {
    /// Whether the next frames should show every cell, if the server permits it.
    fn wants_full_frames(&self) -> bool {
        false
    }

    /// Begins a robot's next episode. The first episodes begin in the order of the robots.
    fn start_episode(&mut self, robot: u32, observation: Observation) -> Result<()>;

    /// Makes the updates that are due after the steps since the last call.
    fn learn(&mut self) -> Result<Vec<ModelUpdate>>;

    /// Returns the agent of a robot, by index.
    fn agent(&self, index: usize) -> &ActingAgent;

    /// Returns the number of world steps learned from, for all robots together.
    fn world_steps(&self) -> u64;

    fn n_updates(&self) -> u64;

    /// Returns what was learned, for a checkpoint from which a later run can resume.
    fn contents(&self) -> Result<Contents>;
}

pub(super) fn replace<R>(runs: &mut Vec<R>, worlds: &Worlds, robot: u32, run: R) -> Option<R> {
    let index = (robot - worlds.numbers.start) as usize;
    match runs.get_mut(index) {
        Some(last) => Some(std::mem::replace(last, run)),
        None => {
            runs.push(run);
            None
        }
    }
}
