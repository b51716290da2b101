//! One step of robots on their worlds: plan, fly, correct, look, predict. Every command steps this way.
//!
//! Pure but for what flies the paths, which the caller gives.

use crate::estimation::scoring::Score;
use crate::planning::Plan;
use crate::rollout::agent::Agent;
use crate::server::feed::View;
use anyhow::Result;
use protocol::client::Observation;
use protocol::message::RobotResult;
use protocol::{Cell, Grid, Move};
use rayon::prelude::*;
use std::ops::Range;
use std::time::{Duration, Instant};

/// An agent at its world: it plans for a robot there, or for several on one belief.
pub struct Robot {
    pub agent: Agent,
    observation: Observation,
    others: Vec<RobotResult>,
    planning: Duration,
}

/// What a world shows to an agent after a step.
#[derive(Debug, Clone)]
pub struct Seen {
    /// Of the first robot that the agent plans for; its frame corrects the belief.
    pub observation: Observation,
    /// What the step gave the others.
    pub others: Vec<RobotResult>,
    /// The hidden states X_k, shape `[H, W]`, where they are published.
    pub truth: Option<Grid<u8>>,
}

/// What a step did to one agent. Between correction and prediction: its belief is the posterior.
pub struct Turn {
    pub before: Observation,
    /// One for each robot that it plans for.
    pub plans: Vec<Plan>,
    /// The hidden states X_{k+1}, where they are published.
    pub truth: Option<Grid<u8>>,
    /// How well the prediction before the frame fits it, where the estimator has one.
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

impl Robot {
    /// An agent before it takes in what its world shows.
    pub fn new(agent: Agent, seen: Seen) -> Self {
        Self {
            agent,
            observation: seen.observation,
            others: seen.others,
            planning: Duration::ZERO,
        }
    }

    /// Takes in what the world shows; `look` finds the posterior. The belief is then about X_{k+1}.
    pub fn begin(&mut self, truth: Option<&Grid<u8>>, look: impl FnOnce(&Self)) -> Result<()> {
        self.correct(truth)?;
        look(self);
        self.agent.predict();
        Ok(())
    }

    /// [`Self::new`] and [`Self::begin`].
    pub fn at(agent: Agent, seen: Seen) -> Result<Self> {
        let truth = seen.truth.clone();
        let mut robot = Self::new(agent, seen);
        robot.begin(truth.as_ref(), |_| ())?;
        Ok(robot)
    }

    /// What it tells observers at its world; `robots`: numbers of those that it flies.
    pub fn view(&self, world: u32, robots: Range<u32>) -> View<'_> {
        View {
            world,
            robots,
            result: &self.observation.world,
            belief: self.agent.belief(),
            intent: self.agent.intent(self.planning),
        }
    }

    pub fn observation(&self) -> &Observation {
        &self.observation
    }

    /// What the last step gave each robot that it plans for.
    pub fn results(&self) -> impl Iterator<Item = &RobotResult> {
        std::iter::once(&self.observation.robot).chain(&self.others)
    }

    /// Time that its last plan took.
    pub fn planning(&self) -> Duration {
        self.planning
    }

    /// Plans the next path of each robot on the agent's policy.
    pub fn plan(&mut self) -> Vec<Plan> {
        self.plan_with(Agent::plan)
    }

    /// Plans the next paths by other means: given the agent, the robots' cells and the step k.
    pub fn plan_with(
        &mut self,
        plan: impl FnOnce(&mut Agent, &[Cell], u64) -> Vec<Plan>,
    ) -> Vec<Plan> {
        let start = Instant::now();
        let cells: Vec<Cell> = self.results().map(RobotResult::cell).collect();
        let plans = plan(&mut self.agent, &cells, self.observation.world.step);
        self.planning = start.elapsed();
        plans
    }

    /// Takes in what its world shows after steps in which its paths were not flown; the belief is then the posterior.
    pub fn catch_up(&mut self, seen: Seen) -> Result<()> {
        let truth = self.take_in(seen).1;
        self.correct(truth.as_ref())
    }

    fn see(&mut self, plans: Vec<Plan>, seen: Seen) -> Result<Turn> {
        let score = self.agent.score(&seen.observation.frame)?;
        let (before, truth) = self.take_in(seen);
        self.correct(truth.as_ref())?;
        self.agent.earn(self.observation.robot.reward);
        Ok(Turn {
            before,
            plans,
            truth,
            score,
        })
    }

    /// Returns what its world showed before, and the hidden states.
    fn take_in(&mut self, seen: Seen) -> (Observation, Option<Grid<u8>>) {
        self.others = seen.others;
        let before = std::mem::replace(&mut self.observation, seen.observation);
        (before, seen.truth)
    }

    fn correct(&mut self, truth: Option<&Grid<u8>>) -> Result<()> {
        self.agent.correct(&self.observation.frame, truth)
    }
}

/// One step of all agents. `robot` finds a run's own; `plan` chooses the paths of its robots; `fly` flies
/// all paths and gives what each agent sees then, in order; `look` is told of each run's turn, by its index, one after
/// the other.
pub fn step<R: Send>(
    runs: &mut [R],
    robot: impl Fn(&mut R) -> &mut Robot + Sync,
    plan: impl Fn(&mut R) -> Vec<Plan> + Sync,
    fly: impl FnOnce(&[Vec<Move>]) -> Result<Vec<Seen>>,
    mut look: impl FnMut(usize, &mut R, Turn) -> Result<()>,
) -> Result<()> {
    let plans = in_parallel(runs.iter_mut(), plan);
    let paths = plans.iter().flatten().map(|plan| plan.moves.clone());
    let paths: Vec<Vec<Move>> = paths.collect();
    let seen = runs.iter_mut().zip(plans).zip(fly(&paths)?);
    let turns = in_parallel(seen, |((run, plans), seen)| robot(run).see(plans, seen));
    for (index, (run, turn)) in runs.iter_mut().zip(turns).enumerate() {
        look(index, run, turn?)?;
    }
    in_parallel(runs.iter_mut(), |run| robot(run).agent.predict());
    Ok(())
}

/// The results in order. One alone is worked on here: handing it to another thread costs more than it gains.
pub fn in_parallel<T: Send, U: Send>(
    tasks: impl Iterator<Item = T>,
    work: impl Fn(T) -> U + Sync,
) -> Vec<U> {
    let tasks: Vec<T> = tasks.collect();
    match tasks.len() {
        1 => tasks.into_iter().map(&work).collect(),
        _ => tasks.into_par_iter().map(&work).collect(),
    }
}
