//! An agent with its world, and the step that all commands share: plan, fly, see, predict. All communication happens in
//! implementations of [`Environment`].

pub mod agent;
pub mod building;

use self::agent::Agent;
use crate::parallel::in_parallel;
use anyhow::Result;
use emberwatch_belief::estimation::scoring::Score;
use emberwatch_belief::planning::Plan;
use emberwatch_messages::message::RobotResult;
use emberwatch_messages::observation::Observation;
use emberwatch_model::{Cell, Grid, Move};

/// Runs one step in all worlds of an environment. Returns `None` if the environment was stopped before the step.
///
/// # Errors
/// If the environment cannot fly the paths, or a frame is impossible under a belief.
pub fn step(
    actor: &mut (impl Actor + ?Sized),
    environment: &mut impl Environment,
) -> Result<Option<Vec<StepRecord>>> {
    let paths = actor.plan();
    let Some(seen) = environment.step(&paths)? else {
        return Ok(None);
    };
    let records = actor.see(seen)?;
    actor.predict();
    Ok(Some(records))
}

/// The decision maker of a step: one or more agents, or a learner.
pub trait Actor {
    /// Plans the path of each robot for step k -> k + 1.
    fn plan(&mut self) -> Vec<Vec<Move>>;

    /// Corrects each agent's belief with its observation after the step. The beliefs are then posteriors about X_{k+1}.
    ///
    /// # Errors
    /// If a frame is impossible under a belief.
    fn see(&mut self, seen: Vec<AgentObservation>) -> Result<Vec<StepRecord>>;

    /// Predicts all beliefs one step ahead.
    fn predict(&mut self);
}

/// The worlds in which an actor acts, on a server or in this process.
pub trait Environment {
    /// Flies a path with each robot. Returns each agent's observation afterwards, or `None` if stopped before the step.
    ///
    /// # Errors
    /// If the environment cannot fly the paths.
    fn step(&mut self, paths: &[Vec<Move>]) -> Result<Option<Vec<AgentObservation>>>;
}

/// An agent and its world's last observation. It plans for one robot, or for several that share one belief.
pub struct ActingAgent {
    pub agent: Agent,
    seen: AgentObservation,
}

/// The observation that an agent receives.
#[derive(Debug, Clone)]
pub struct AgentObservation {
    /// Observation of the agent's first robot. Its frame corrects the belief.
    pub observation: Observation,
    /// Results of the agent's other robots.
    pub others: Vec<RobotResult>,
    /// The hidden states X_k, shape `[H, W]`, if they are published.
    pub truth: Option<Grid<u8>>,
}

/// The result of a step for an agent.
#[derive(Debug)]
pub struct StepRecord {
    /// The observation before the step.
    pub before: Observation,
    /// Reward of the agent's first robot.
    pub reward: f64,
    /// Score of the predicted frame, if the estimator predicts frames.
    pub score: Option<Score>,
}

impl AgentObservation {
    /// Combines the observations of an agent's robots in one world. There must be at least one observation.
    pub fn new(observations: impl IntoIterator<Item = Observation>) -> Self {
        let mut observations = observations.into_iter();
        let first = observations.next();
        Self {
            observation: first.expect("invariant: an agent has a robot"),
            others: observations.map(|other| other.robot).collect(),
            truth: None,
        }
    }
}

impl ActingAgent {
    /// Creates it without correcting the agent's belief with the observation.
    pub fn new(agent: Agent, seen: AgentObservation) -> Self {
        Self { agent, seen }
    }

    /// Creates it, corrects the belief with the observation, and predicts it one step ahead.
    pub fn begun(agent: Agent, seen: AgentObservation) -> Result<Self> {
        let mut acting = Self::new(agent, seen);
        acting.correct()?;
        acting.agent.predict();
        Ok(acting)
    }

    /// Plans the paths for step k -> k + 1, one for each robot.
    pub fn plan(&mut self) -> Vec<Plan> {
        let (cells, step) = (self.cells(), self.step());
        self.agent.plan(&cells, step)
    }

    /// Corrects the belief with the observation after a step. The belief is then the posterior.
    pub fn see(&mut self, seen: AgentObservation) -> Result<StepRecord> {
        let score = self.agent.score(&seen.observation.frame);
        let before = std::mem::replace(&mut self.seen, seen);
        self.correct()?;
        Ok(StepRecord {
            before: before.observation,
            reward: self.observation().robot.reward,
            score,
        })
    }

    /// Corrects the belief with the stored observation, and records the reward. The belief is then the posterior.
    pub fn correct(&mut self) -> Result<()> {
        let AgentObservation {
            observation, truth, ..
        } = &self.seen;
        self.agent.correct(&observation.frame, truth.as_ref())?;
        // There is no reward before the first path.
        if observation.world.step > 0 {
            self.agent.earn(observation.robot.reward);
        }
        Ok(())
    }

    pub fn observation(&self) -> &Observation {
        &self.seen.observation
    }

    /// Returns the hidden states X_k, if they are published.
    pub fn truth(&self) -> Option<&Grid<u8>> {
        self.seen.truth.as_ref()
    }

    /// Returns the world's step k.
    pub fn step(&self) -> u64 {
        self.observation().world.step
    }

    /// Returns the results of the last step for each of the agent's robots.
    pub fn results(&self) -> impl Iterator<Item = &RobotResult> {
        std::iter::once(&self.observation().robot).chain(&self.seen.others)
    }

    /// Returns the cells of the agent's robots.
    pub fn cells(&self) -> Vec<Cell> {
        self.results().map(RobotResult::cell).collect()
    }
}

impl Actor for Vec<ActingAgent> {
    fn plan(&mut self) -> Vec<Vec<Move>> {
        let plans = in_parallel(self, ActingAgent::plan);
        plans.into_iter().flatten().map(|plan| plan.moves).collect()
    }

    fn see(&mut self, seen: Vec<AgentObservation>) -> Result<Vec<StepRecord>> {
        see_all(self, seen)
    }

    fn predict(&mut self) {
        predict_all(self);
    }
}

/// Corrects each agent's belief with its observation after the step. The beliefs are then posteriors.
pub fn see_all<'a>(
    agents: impl IntoIterator<Item = &'a mut ActingAgent>,
    seen: Vec<AgentObservation>,
) -> Result<Vec<StepRecord>> {
    let pairs = agents.into_iter().zip(seen);
    let records = in_parallel(pairs, |(acting, seen)| acting.see(seen));
    records.into_iter().collect()
}

/// Predicts all beliefs one step ahead.
pub fn predict_all<'a>(agents: impl IntoIterator<Item = &'a mut ActingAgent>) {
    Agent::predict_all(agents.into_iter().map(|acting| &mut acting.agent));
}
