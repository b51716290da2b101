//! Replay in, parameters out, step by step.

use crate::config::{AgentConfig, LearningConfig};
use crate::estimation::Correlations;
use crate::estimation::belief::Belief;
use crate::estimation::parameters::{Dimensions, Parameters, Tables};
use crate::learning::filter::{Iterates, NotFinite, Trainer, Update};
use crate::learning::learner::neighbours::Neighbours;
use crate::learning::replay::Replay;
use crate::learning::reward::{RewardEstimate, met};
use protocol::{Frame, Shape};
use std::collections::BTreeMap;

/// How checkpoints of this learner call it.
pub const KIND: &str = "learned_filter";

/// What was learned: all that acting on it needs.
#[derive(Debug, Clone, PartialEq)]
pub struct LearnedModel {
    /// The filter's parameters.
    pub tables: Tables,
    /// The state that pays most.
    pub target: usize,
    /// How much that state of one cell says of its neighbours'.
    pub correlations: Correlations,
}

/// The state of learning.
#[derive(Debug, Clone, PartialEq)]
pub struct Progress {
    /// The parameters, and how they come to be.
    pub iterates: Iterates,
    /// Which state pays.
    pub reward: RewardEstimate,
    /// World steps seen, of all worlds together.
    pub world_steps: u64,
    /// How much cells say of their neighbours.
    pub neighbours: Neighbours,
}

/// Learns from frames as they come.
#[derive(Debug, Clone)]
pub struct Learner {
    pub(super) shape: Shape,
    pub(super) trainer: Trainer,
    pub(super) replay: Replay,
    pub(super) reward: RewardEstimate,
    pub(super) config: LearningConfig,
    pub(super) world_steps: u64,
    /// Updates that steps have earned and that are not made yet.
    pub(super) owed: f64,
    pub(super) neighbours: Neighbours,
    /// Beliefs before the next frames, by world.
    predictors: BTreeMap<u32, Belief>,
}

impl Learner {
    /// A learner with an empty replay.
    pub fn new(progress: Progress, shape: Shape, config: &AgentConfig) -> Self {
        let learning = config.learning;
        let Progress {
            iterates,
            reward,
            world_steps,
            neighbours,
        } = progress;
        let block = learning.window * learning.block_windows;
        Self {
            shape,
            trainer: Trainer::resume(iterates, shape, learning, config.seed),
            replay: Replay::new(block, learning.replay_frames),
            reward,
            config: learning,
            world_steps,
            owed: 0.0,
            neighbours,
            predictors: BTreeMap::new(),
        }
    }

    /// A world's track begins, for the first time or again.
    pub fn begin(&mut self, world: u32) {
        self.replay.begin(world);
        self.neighbours.begin(world, self.shape.n_cells());
    }

    /// Whether a world's track was begun.
    pub fn has_track(&self, world: u32) -> bool {
        self.replay.has_track(world)
    }

    /// The belief before a world's next frame.
    pub fn expect(&mut self, world: u32, predictor: &Belief) {
        if self.replay.wants_belief(world) {
            self.replay.give_belief(world, predictor.as_slice());
        }
        self.predictors.insert(world, predictor.clone());
    }

    /// A world's next frame.
    pub fn see(&mut self, world: u32, frame: &Frame) {
        self.replay.push(world, frame);
        let LearnedModel { tables, target, .. } = self.learned();
        let learned = (&tables.likelihood_array(), target);
        let predictor = self.predictors.remove(&world);
        self.neighbours
            .see(world, frame, predictor.as_ref(), learned);
    }

    /// The reward of a path that visited some cells, with the belief after its frame.
    pub fn reward(&mut self, posterior: &Belief, visited: &[usize], reward: f64) {
        let met = met(posterior, visited.iter().copied());
        self.reward.add(&met, reward);
        self.world_steps += 1;
        self.owed += self.config.updates_per_step;
    }

    /// Makes the updates that the steps since the last call have earned.
    ///
    /// # Errors
    /// [`NotFinite`]: learning cannot go on; the parameters are those before.
    pub fn learn(&mut self) -> Result<Vec<Update>, NotFinite> {
        let mut updates = Vec::new();
        let target = self.reward.target();
        while self.owed >= 1.0 {
            self.owed -= 1.0;
            updates.extend(self.trainer.update(&mut self.replay, target)?);
        }
        Ok(updates)
    }

    /// Forgets all frames, and every world's track; what was learned from them stays.
    pub fn forget(&mut self) {
        let learning = self.config;
        let block = learning.window * learning.block_windows;
        self.replay = Replay::new(block, learning.replay_frames);
        self.trainer.leave_replay();
        self.owed = 0.0;
        self.neighbours.forget_worlds();
    }

    /// What is known by now.
    pub fn learned(&self) -> LearnedModel {
        let parameters = &self.trainer.iterates().parameters;
        learned(parameters, &self.reward, &self.neighbours)
    }

    /// World steps seen, of all worlds together.
    pub fn world_steps(&self) -> u64 {
        self.world_steps
    }

    /// Updates made.
    pub fn n_updates(&self) -> u64 {
        self.trainer.iterates().adam.n_steps
    }
}

impl Progress {
    /// Before the first frame.
    pub fn first(dimensions: Dimensions, seed: u64) -> Self {
        Self {
            iterates: Iterates::first(Parameters::first(dimensions, seed)),
            reward: RewardEstimate::new(dimensions.n_states),
            world_steps: 0,
            neighbours: Neighbours::default(),
        }
    }

    /// What is known by then.
    pub fn learned(&self) -> LearnedModel {
        learned(&self.iterates.parameters, &self.reward, &self.neighbours)
    }
}

fn learned(
    parameters: &Parameters,
    reward: &RewardEstimate,
    neighbours: &Neighbours,
) -> LearnedModel {
    LearnedModel {
        correlations: neighbours.correlations().clone(),
        tables: parameters.tables(),
        target: reward
            .target()
            .unwrap_or(parameters.dimensions.n_states - 1),
    }
}
