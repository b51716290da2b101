//! An agent at its world, and the step that every command takes: plan, fly, see, predict. Pure: an environment flies.

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

/// One step of the worlds of an environment; `None` if it was stopped before they moved.
///
/// # Errors
/// If paths are not flown, or a frame is impossible under a belief.
pub fn step(
    actor: &mut (impl Actor + ?Sized),
    environment: &mut impl Environment,
) -> Result<Option<Vec<StepRecord>>> {
    let paths = actor.plan();
    let Some(seen) = environment.fly(&paths)? else {
        return Ok(None);
    };
    let records = actor.see(seen)?;
    actor.predict();
    Ok(Some(records))
}

/// What acts on worlds: an agent, several, or what learns while it acts.
pub trait Actor {
    /// The path of each robot for step k -> k + 1.
    fn plan(&mut self) -> Vec<Vec<Move>>;

    /// Takes in what each agent sees after the step; the beliefs are then posteriors, about X_{k+1}.
    ///
    /// # Errors
    /// If a frame is impossible under a belief.
    fn see(&mut self, seen: Vec<Seen>) -> Result<Vec<StepRecord>>;

    /// Moves all beliefs to the next step.
    fn predict(&mut self);
}

/// Where it acts: a server's worlds, or worlds in this process.
pub trait Environment {
    /// Flies a path with each robot; returns what each agent sees then, or `None` if it was stopped before that.
    ///
    /// # Errors
    /// If the paths are not flown.
    fn fly(&mut self, paths: &[Vec<Move>]) -> Result<Option<Vec<Seen>>>;
}

/// An agent and what its world shows it: it plans for one robot there, or for several on one belief.
pub struct Rollout {
    pub agent: Agent,
    seen: Seen,
}

/// What a world shows to an agent.
#[derive(Debug, Clone)]
pub struct Seen {
    /// Of the first robot that the agent plans for; its frame corrects the belief.
    pub observation: Observation,
    /// What the step gave the others.
    pub others: Vec<RobotResult>,
    /// The hidden states X_k, shape `[H, W]`, where they are published.
    pub truth: Option<Grid<u8>>,
}

/// What a step changed for an agent.
#[derive(Debug)]
pub struct StepRecord {
    /// What the world showed before.
    pub before: Observation,
    /// What the step gave its first robot.
    pub reward: f64,
    /// How well the prediction before the frame fits it, where the estimator predicts frames.
    pub score: Option<Score>,
}

impl Seen {
    /// What an agent sees that plans for these robots of one world, at least one.
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

impl Rollout {
    /// An agent that has not yet taken in what its world shows.
    pub fn new(agent: Agent, seen: Seen) -> Self {
        Self { agent, seen }
    }

    /// An agent that has: its belief is about X_{k+1}.
    pub fn begun(agent: Agent, seen: Seen) -> Result<Self> {
        let mut rollout = Self::new(agent, seen);
        rollout.correct()?;
        rollout.agent.predict();
        Ok(rollout)
    }

    /// The paths for step k -> k + 1, one for each robot.
    pub fn plan(&mut self) -> Vec<Plan> {
        let (cells, step) = (self.cells(), self.step());
        self.agent.plan(&cells, step)
    }

    /// Takes in what the world shows after a step; the belief is then the posterior.
    pub fn see(&mut self, seen: Seen) -> Result<StepRecord> {
        let score = self.agent.score(&seen.observation.frame);
        let before = std::mem::replace(&mut self.seen, seen);
        self.correct()?;
        Ok(StepRecord {
            before: before.observation,
            reward: self.observation().robot.reward,
            score,
        })
    }

    /// Takes in what the world shows now; the belief is then the posterior.
    pub fn correct(&mut self) -> Result<()> {
        let Seen {
            observation, truth, ..
        } = &self.seen;
        self.agent.correct(&observation.frame, truth.as_ref())?;
        // Nothing was flown before the first frame.
        if observation.world.step > 0 {
            self.agent.earn(observation.robot.reward);
        }
        Ok(())
    }

    pub fn observation(&self) -> &Observation {
        &self.seen.observation
    }

    /// The hidden states X_k, where they are published.
    pub fn truth(&self) -> Option<&Grid<u8>> {
        self.seen.truth.as_ref()
    }

    /// The world's step k.
    pub fn step(&self) -> u64 {
        self.observation().world.step
    }

    /// What the last step gave each robot that it plans for.
    pub fn results(&self) -> impl Iterator<Item = &RobotResult> {
        std::iter::once(&self.observation().robot).chain(&self.seen.others)
    }

    /// Where these robots are.
    pub fn cells(&self) -> Vec<Cell> {
        self.results().map(RobotResult::cell).collect()
    }
}

/// Agents, each on its own belief.
impl Actor for Vec<Rollout> {
    fn plan(&mut self) -> Vec<Vec<Move>> {
        paths_of(in_parallel(self, Rollout::plan))
    }

    fn see(&mut self, seen: Vec<Seen>) -> Result<Vec<StepRecord>> {
        see_all(self, seen)
    }

    fn predict(&mut self) {
        predict_all(self);
    }
}

/// The paths of all agents' plans, in order.
pub fn paths_of(plans: impl IntoIterator<Item = Vec<Plan>>) -> Vec<Vec<Move>> {
    let plans = plans.into_iter().flatten();
    plans.map(|plan| plan.moves).collect()
}

/// Gives each agent what it sees after the step; the beliefs are then posteriors.
pub fn see_all<'a>(
    rollouts: impl IntoIterator<Item = &'a mut Rollout>,
    seen: Vec<Seen>,
) -> Result<Vec<StepRecord>> {
    let pairs = rollouts.into_iter().zip(seen);
    let records = in_parallel(pairs, |(rollout, seen)| rollout.see(seen));
    records.into_iter().collect()
}

/// Moves all beliefs to the next step.
pub fn predict_all<'a>(rollouts: impl IntoIterator<Item = &'a mut Rollout>) {
    Agent::predict_all(rollouts.into_iter().map(|rollout| &mut rollout.agent));
}
