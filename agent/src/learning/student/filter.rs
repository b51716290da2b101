//! Learns the filter's parameters on several worlds at once: robots walk at random first, then plan on
//! the belief of the filter as it is.

mod saved;

pub use self::saved::SavedFilter;

use self::saved::SavedWorld;
use crate::config::AgentConfig;
use crate::estimation::BayesFilter;
use crate::estimation::belief::Belief;
use crate::estimation::parameters::{Dimensions, Tables};
use crate::learning::checkpoint::Contents;
use crate::learning::learner::{LearnedModel, Learner};
use crate::learning::metrics::{ModelUpdate, Tick};
use crate::learning::student::base::{Fly, Look, Student, Worlds, without_truth};
use crate::planning::policy::{EstimatorKind, PlannerKind, Policy, numbered_states};
use crate::planning::{Objective, Plan, Target};
use crate::rollout::{self, Robot};
use anyhow::Result;
use protocol::client::Observation;
use protocol::path;
use std::collections::BTreeMap;
use std::time::{Duration, Instant};

struct Run {
    robot: Robot,
    is_walking: bool,
    /// The belief before the last frame, unless that was the first.
    predictor: Option<Belief>,
}

impl From<Robot> for Run {
    fn from(robot: Robot) -> Self {
        Self {
            robot,
            is_walking: false,
            predictor: None,
        }
    }
}

pub struct FilterStudent {
    worlds: Worlds,
    config: AgentConfig,
    learner: Learner,
    learned: LearnedModel,
    runs: Vec<Run>,
    /// Where a checkpoint left the worlds.
    left: BTreeMap<u32, SavedWorld>,
    is_frozen: bool,
    planning: Duration,
    learning: Duration,
}

impl FilterStudent {
    /// A student before its first frame.
    pub fn new(dimensions: Dimensions, worlds: Worlds, config: &AgentConfig) -> Self {
        let learner = Learner::new(dimensions, worlds.shape, config);
        Self::of(learner, BTreeMap::new(), worlds, config)
    }

    pub fn resume(
        contents: &Contents,
        dimensions: Dimensions,
        worlds: Worlds,
        config: &AgentConfig,
    ) -> Result<Self> {
        let SavedFilter {
            learner,
            worlds: mut left,
        } = contents.state()?;
        let shape = learner.trainer.shape;
        let learner = Learner::resume(learner, contents, dimensions, worlds.shape, config)?;
        let mut all = left.values();
        all.try_for_each(|world| world.check(dimensions.n_states, shape))?;
        if shape != worlds.shape {
            left.clear();
        }
        Ok(Self::of(learner, left, worlds, config))
    }

    fn of(
        learner: Learner,
        left: BTreeMap<u32, SavedWorld>,
        worlds: Worlds,
        config: &AgentConfig,
    ) -> Self {
        Self {
            learned: learner.learned(),
            learner,
            left,
            worlds,
            config: config.clone(),
            runs: Vec::new(),
            is_frozen: false,
            planning: Duration::ZERO,
            learning: Duration::ZERO,
        }
    }

    /// A robot before it takes in what its world shows.
    fn robot(&self, observation: Observation) -> Robot {
        let tables = &self.learned.tables;
        let filter = BayesFilter::learned(tables, tables.prior(self.worlds.shape));
        let names = numbered_states(tables.dimensions.n_states);
        let (policy, config) = (self.policy(), &self.config);
        let worlds = &self.worlds;
        worlds.robot(config, &policy, Box::new(filter), names, observation)
    }

    /// A robot that has taken in what its world shows, with a track that begins there.
    fn begun(&mut self, world: u32, observation: Observation) -> Result<Run> {
        self.learner.begin(world);
        let frame = &observation.frame;
        self.learner.see(world, frame, None, &self.learned);
        let mut robot = self.robot(observation);
        robot.begin(None, |_| ())?;
        Ok(robot.into())
    }

    /// What robots that don't walk at random act by.
    fn policy(&self) -> Policy {
        let (name, estimator) = match self.learned.tables.dimensions.sees_own_state {
            false => ("learned_beam", EstimatorKind::Learned),
            true => ("learned_own_beam", EstimatorKind::LearnedOwn),
        };
        let target = Target::State(self.learned.target);
        Policy::new(name, estimator, PlannerKind::Beam, target)
    }

    /// Worlds whose robots walk at random: all at first, some for good; none of a frozen student.
    fn n_walking(&self) -> usize {
        if self.is_frozen {
            return 0;
        }
        let learning = &self.config.learning;
        if self.learner.world_steps < learning.explore_steps {
            return self.runs.len();
        }
        (learning.explore_share * self.runs.len() as f64).round() as usize
    }
}

impl Student for FilterStudent {
    fn kind(&self) -> &'static str {
        self.learner.kind()
    }

    fn columns(&self) -> &'static [&'static str] {
        &[]
    }

    fn attach(&mut self, observations: Vec<Observation>) -> Result<usize> {
        let worlds = self.worlds.numbers.clone();
        let mut n_gone_on = 0;
        if !SavedWorld::any_is_of(&self.left, worlds.clone(), &observations) {
            // Frames of other worlds, perhaps of another model.
            self.learner.forget();
        }
        for (world, observation) in worlds.zip(observations) {
            let left = self.left.get(&world);
            let left =
                left.filter(|left| left.is_of(&observation) && self.learner.has_track(world));
            let run = if let Some(left) = left {
                let mut robot = self.robot(observation);
                left.restore(&mut robot.agent);
                n_gone_on += 1;
                robot.into()
            } else {
                self.begun(world, observation)?
            };
            self.runs.push(run);
        }
        Ok(n_gone_on)
    }

    fn begin(&mut self, world: u32, observation: Observation) -> Result<()> {
        let run = self.begun(world, observation)?;
        self.runs[(world - self.worlds.numbers.start) as usize] = run;
        Ok(())
    }

    fn step(&mut self, fly: Fly<'_>, look: Look<'_>) -> Result<Tick> {
        let start = Instant::now();
        if !self.is_frozen {
            self.learned = self.learner.learned();
        }
        let (n_walking, first_world) = (self.n_walking(), self.worlds.numbers.start);
        for (index, run) in self.runs.iter_mut().enumerate() {
            run.is_walking = index < n_walking;
            run.predictor = Some(run.robot.agent.belief().clone());
        }
        let objective = self.config.objective(&self.policy());
        let mut tick = Tick::default();
        rollout::step(
            &mut self.runs,
            |run| &mut run.robot,
            |run| run.plan(&self.learned.tables, objective),
            |paths| {
                self.planning += start.elapsed();
                anyhow::Ok(without_truth(fly(paths)?))
            },
            |index, run, turn| {
                let (agent, observation) = (&run.robot.agent, run.robot.observation());
                let path = &turn.plans[0].moves;
                let visited = path::fly(self.worlds.shape, turn.before.robot.cell(), path);
                let reward = observation.robot.reward;
                let (world, predictor) = (first_world + index as u32, run.predictor.as_ref());
                self.learner
                    .see(world, &observation.frame, predictor, &self.learned);
                self.learner
                    .reward(agent.belief(), &visited.visited, reward);
                tick.reward += reward;
                tick.score += turn.score.unwrap_or_default();
                look(index, &run.robot);
                Ok(())
            },
        )?;
        tick.n_worlds = self.runs.len() as u64;
        tick.world_steps = self.learner.world_steps;
        Ok(tick)
    }

    fn learn(&mut self) -> Result<Vec<ModelUpdate>> {
        let start = Instant::now();
        let updates = self.learner.learn();
        self.learning += start.elapsed();
        let update = |update: crate::learning::filter::Update| ModelUpdate {
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
        self.learner.world_steps
    }

    fn n_updates(&self) -> u64 {
        self.learner.n_updates()
    }

    fn belief(&self) -> Option<(&Belief, usize)> {
        let run = self.runs.first()?;
        Some((run.robot.agent.belief(), self.learned.target))
    }

    fn contents(&self) -> Result<Contents> {
        let saved = self.runs.iter().map(|run| SavedWorld::of(&run.robot));
        let worlds: BTreeMap<_, _> = self.worlds.numbers.clone().zip(saved).collect();
        // As `SavedFilter`, without a copy of the learner.
        let state = (&self.learner, worlds);
        Ok(Contents::new(self.learner.named_tensors(), &state))
    }

    fn times(&self) -> Vec<(&'static str, Duration)> {
        vec![("planning", self.planning), ("updates", self.learning)]
    }
}

impl Run {
    /// The next path on newer parameters.
    fn plan(&mut self, tables: &Tables, objective: Objective) -> Vec<Plan> {
        let is_walking = self.is_walking;
        self.robot.agent.estimator_mut().set_tables(tables);
        self.robot
            .plan_with(|agent, robots, step| match is_walking {
                true => agent.walk(robots, step),
                false => agent.plan_for(objective, robots, step),
            })
    }
}
