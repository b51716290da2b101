//! Learns the filter's parameters on several worlds at once: robots walk at random first, then plan on
//! the belief of the filter as it is.

pub mod fit;
pub mod form;
pub mod model;
mod saved;

pub use self::saved::SavedFilter;

use self::saved::SavedWorld;
use crate::checkpoint::Contents;
use crate::config::AgentConfig;
use crate::learners::base::{Learner, Worlds, without_truth};
use crate::learners::filter::fit::{FilterFit, LearnedModel};
use crate::policy::{EstimatorKind, PlannerKind, Policy, numbered_states};
use crate::rollout::{Rollout, in_parallel, predict_all, see_all};
use crate::update::{ModelUpdate, Tick};
use anyhow::Result;
use emberwatch_belief::estimation::BayesFilter;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::parameters::Dimensions;
use emberwatch_belief::planning::{Plan, Target};
use emberwatch_messages::observation::Observation;
use emberwatch_model::Move;
use std::collections::BTreeMap;
use std::time::{Duration, Instant};

pub struct FilterLearner {
    worlds: Worlds,
    config: AgentConfig,
    fit: FilterFit,
    learned: LearnedModel,
    rollouts: Vec<Rollout>,
    /// What was planned last, of each robot: its belief then, and its path.
    planned: Vec<(Belief, Plan)>,
    /// Where a checkpoint left the worlds.
    left: BTreeMap<u32, SavedWorld>,
    is_frozen: bool,
    planning: Duration,
    learning: Duration,
}

impl FilterLearner {
    /// A learner before its first frame.
    pub fn new(dimensions: Dimensions, worlds: Worlds, config: &AgentConfig) -> Self {
        let zones = worlds.zones.clone();
        let fit = FilterFit::new(dimensions, zones, worlds.shape(), config);
        Self::of(fit, BTreeMap::new(), worlds, config)
    }

    pub fn resume(
        contents: &Contents,
        dimensions: Dimensions,
        worlds: Worlds,
        config: &AgentConfig,
    ) -> Result<Self> {
        let SavedFilter {
            fit,
            worlds: mut left,
        } = contents.state()?;
        let shape = fit.optimiser.shape;
        let zones = worlds.zones.clone();
        let fit = FilterFit::resume(fit, contents, dimensions, zones, worlds.shape(), config)?;
        let mut all = left.values();
        all.try_for_each(|world| world.check(dimensions.n_states, shape))?;
        if shape != worlds.shape() {
            left.clear();
        }
        Ok(Self::of(fit, left, worlds, config))
    }

    fn of(
        fit: FilterFit,
        left: BTreeMap<u32, SavedWorld>,
        worlds: Worlds,
        config: &AgentConfig,
    ) -> Self {
        Self {
            learned: fit.learned(),
            fit,
            left,
            worlds,
            config: config.clone(),
            rollouts: Vec::new(),
            planned: Vec::new(),
            is_frozen: false,
            planning: Duration::ZERO,
            learning: Duration::ZERO,
        }
    }

    /// A robot before it takes in what its world shows.
    fn rollout_at(&self, observation: Observation) -> Rollout {
        let tables = &self.learned.tables;
        let filter = BayesFilter::learned(tables, tables.prior(self.worlds.shape()));
        let names = numbered_states(tables.dimensions.n_states);
        let (policy, config) = (self.policy(), &self.config);
        let worlds = &self.worlds;
        worlds.rollout(config, &policy, Box::new(filter), names, observation)
    }

    /// A robot that has taken in what its world shows, with a track that begins there.
    fn begun(&mut self, world: u32, observation: Observation) -> Result<Rollout> {
        self.fit.begin(world);
        let frame = &observation.frame;
        self.fit.see(world, frame, None, &self.learned);
        let mut rollout = self.rollout_at(observation);
        rollout.correct()?;
        rollout.agent.predict();
        Ok(rollout)
    }

    /// What robots that don't walk at random act by.
    fn policy(&self) -> Policy {
        let estimator = EstimatorKind::learned(self.learned.tables.dimensions.sees_own_state);
        let name = format!("{}_beam", estimator.family());
        let target = Target::State(self.learned.target);
        Policy::new(&name, estimator, PlannerKind::Beam, target)
    }

    /// Worlds whose robots walk at random: all at first, some for good; none of a frozen learner.
    fn n_walking(&self) -> usize {
        if self.is_frozen {
            return 0;
        }
        let learning = &self.config.learning;
        if self.fit.world_steps < learning.explore_steps {
            return self.rollouts.len();
        }
        (learning.explore_share * self.rollouts.len() as f64).round() as usize
    }
}

impl Learner for FilterLearner {
    fn kind(&self) -> &'static str {
        self.fit.kind()
    }

    fn columns(&self) -> &'static [&'static str] {
        &[]
    }

    fn attach(&mut self, observations: Vec<Observation>) -> Result<usize> {
        let worlds = self.worlds.numbers.clone();
        let mut n_gone_on = 0;
        if !SavedWorld::any_is_of(&self.left, worlds.clone(), &observations) {
            // Frames of other worlds, perhaps of another model.
            self.fit.forget();
        }
        for (world, observation) in worlds.zip(observations) {
            let left = self.left.get(&world);
            let left = left.filter(|left| left.is_of(&observation) && self.fit.has_track(world));
            let rollout = if let Some(left) = left {
                let mut rollout = self.rollout_at(observation);
                left.restore(&mut rollout.agent);
                n_gone_on += 1;
                rollout
            } else {
                self.begun(world, observation)?
            };
            self.rollouts.push(rollout);
        }
        Ok(n_gone_on)
    }

    fn begin(&mut self, world: u32, observation: Observation) -> Result<()> {
        let rollout = self.begun(world, observation)?;
        self.rollouts[(world - self.worlds.numbers.start) as usize] = rollout;
        Ok(())
    }

    fn plan(&mut self) -> Vec<Vec<Move>> {
        let start = Instant::now();
        if !self.is_frozen {
            self.learned = self.fit.learned();
        }
        let (n_walking, tables) = (self.n_walking(), &self.learned.tables);
        let objective = self.config.objective(&self.policy());
        let rollouts = self.rollouts.iter_mut().enumerate();
        self.planned = in_parallel(rollouts, |(index, rollout)| {
            let belief = rollout.agent.belief().clone();
            let filter = BayesFilter::learned(tables, belief.clone());
            rollout.agent.set_estimator(Box::new(filter));
            let (cells, step) = (rollout.cells(), rollout.step());
            let mut plans = if index < n_walking {
                rollout.agent.walk(&cells, step)
            } else {
                rollout.agent.plan_for(objective, &cells, step)
            };
            (belief, plans.remove(0))
        });
        self.planning += start.elapsed();
        let plans = self.planned.iter();
        plans.map(|(_, plan)| plan.moves.clone()).collect()
    }

    fn see(&mut self, observations: Vec<Observation>) -> Result<Tick> {
        let turns = see_all(&mut self.rollouts, without_truth(observations))?;
        let mut tick = Tick::default();
        let runs = self.rollouts.iter().zip(&self.planned).zip(turns);
        for (world, ((rollout, (predictor, plan)), turn)) in (self.worlds.numbers.start..).zip(runs)
        {
            let (belief, observation) = (rollout.agent.belief(), rollout.observation());
            let reward = observation.robot.reward;
            let start = turn.before.robot.cell();
            let paying = self.worlds.airspace.paying(start, &plan.moves);
            self.fit
                .see(world, &observation.frame, Some(predictor), &self.learned);
            self.fit.reward(belief, &paying, reward);
            tick.reward += reward;
            tick.score += turn.score.unwrap_or_default();
        }
        tick.n_worlds = self.rollouts.len() as u64;
        tick.world_steps = self.fit.world_steps;
        Ok(tick)
    }

    fn rollout(&self, index: usize) -> &Rollout {
        &self.rollouts[index]
    }

    fn predict(&mut self) {
        predict_all(&mut self.rollouts);
    }

    fn learn(&mut self) -> Result<Vec<ModelUpdate>> {
        let start = Instant::now();
        let updates = self.fit.learn();
        self.learning += start.elapsed();
        let update = |update: crate::filter::Update| ModelUpdate {
            number: update.number,
            loss: Some(update.loss),
            rate: Some(update.rate),
            more: Vec::new(),
        };
        Ok(updates?.into_iter().map(update).collect())
    }

    fn freeze(&mut self) {
        self.is_frozen = true;
    }

    fn world_steps(&self) -> u64 {
        self.fit.world_steps
    }

    fn n_updates(&self) -> u64 {
        self.fit.n_updates()
    }

    fn lacks(&self, steps: u64) -> String {
        self.fit.lacks(steps)
    }

    fn belief(&self) -> Option<(&Belief, usize)> {
        let rollout = self.rollouts.first()?;
        Some((rollout.agent.belief(), self.learned.target))
    }

    fn contents(&self) -> Result<Contents> {
        let saved = self.rollouts.iter().map(SavedWorld::of);
        let worlds: BTreeMap<_, _> = self.worlds.numbers.clone().zip(saved).collect();
        // As `SavedFilter`, without a copy of the learner.
        let state = (&self.fit, worlds);
        Ok(Contents::new(self.fit.named_tensors(), &state))
    }

    fn times(&self) -> Vec<(&'static str, Duration)> {
        vec![("planning", self.planning), ("updates", self.learning)]
    }
}
