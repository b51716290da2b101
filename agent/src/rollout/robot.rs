//! One step of robots on their worlds: plan, fly, correct, look, predict. Every command steps this way.
//!
//! Pure but for what flies the paths, which the caller gives.

use crate::estimation::scoring::Score;
use crate::planning::Plan;
use crate::rollout::agent::Agent;
use crate::server::client::Observation;
use crate::server::feed::View;
use anyhow::Result;
use protocol::{Cell, Grid, Move};
use rayon::prelude::*;
use std::time::{Duration, Instant};

/// An agent at its world.
pub struct Robot {
    pub agent: Agent,
    observation: Observation,
    planning: Duration,
}

/// What a world shows after a step.
#[derive(Debug, Clone)]
pub struct Seen {
    pub observation: Observation,
    /// The hidden states X_k, shape `[H, W]`, where they are published.
    pub truth: Option<Grid<u8>>,
}

/// What a step did to one robot. Between correction and prediction: its agent's belief is the posterior.
pub struct Turn {
    pub before: Observation,
    pub plan: Plan,
    /// The hidden states X_{k+1}, where they are published.
    pub truth: Option<Grid<u8>>,
    /// How well the prediction before the frame fits it, where the estimator has one.
    pub score: Option<Score>,
}

impl Robot {
    /// An agent before it takes in what its world shows.
    pub fn new(agent: Agent, observation: Observation) -> Self {
        Self {
            agent,
            observation,
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
        let mut robot = Self::new(agent, seen.observation);
        robot.begin(seen.truth.as_ref(), |_| ())?;
        Ok(robot)
    }

    /// What it tells those who look on at its world.
    pub fn view(&self, world: u32) -> View<'_> {
        View {
            world,
            result: &self.observation.result,
            belief: self.agent.belief(),
            intent: self.agent.intent(self.planning),
        }
    }

    pub fn observation(&self) -> &Observation {
        &self.observation
    }

    /// Time that its last plan took.
    pub fn planning(&self) -> Duration {
        self.planning
    }

    /// Plans the next path on the agent's policy.
    pub fn plan(&mut self) -> Plan {
        self.plan_with(Agent::plan)
    }

    /// Plans the next path by other means: given the agent, the robot's cell and the step k.
    pub fn plan_with(&mut self, plan: impl FnOnce(&mut Agent, Cell, u64) -> Plan) -> Plan {
        let start = Instant::now();
        let (cell, step) = (self.observation.robot(), self.observation.result.step);
        let plan = plan(&mut self.agent, cell, step);
        self.planning = start.elapsed();
        plan
    }

    fn see(&mut self, plan: Plan, seen: Seen) -> Result<Turn> {
        let Seen { observation, truth } = seen;
        let score = self.agent.score(&observation.frame)?;
        let before = std::mem::replace(&mut self.observation, observation);
        self.correct(truth.as_ref())?;
        Ok(Turn {
            before,
            plan,
            truth,
            score,
        })
    }

    fn correct(&mut self, truth: Option<&Grid<u8>>) -> Result<()> {
        self.agent.correct(&self.observation.frame, truth)
    }
}

/// One step of all robots. `robot` finds a run's own; `plan` chooses its path; `fly` flies all paths and gives what
/// each world shows then, in order; `look` is told of each run's turn, by its index, one after the other.
pub fn step<R: Send>(
    runs: &mut [R],
    robot: impl Fn(&mut R) -> &mut Robot + Sync,
    plan: impl Fn(&mut R) -> Plan + Sync,
    fly: impl FnOnce(&[Vec<Move>]) -> Result<Vec<Seen>>,
    mut look: impl FnMut(usize, &mut R, Turn) -> Result<()>,
) -> Result<()> {
    let plans = in_parallel(runs.iter_mut(), plan);
    let paths: Vec<Vec<Move>> = plans.iter().map(|plan| plan.moves.clone()).collect();
    let seen = runs.iter_mut().zip(plans).zip(fly(&paths)?);
    let turns = in_parallel(seen, |((run, plan), seen)| robot(run).see(plan, seen));
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
