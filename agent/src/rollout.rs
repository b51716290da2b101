//! One step of agents on their worlds: plan, fly, correct, look, predict. Every command steps this way.
//!
//! Pure but for what flies the paths, which the caller gives.

use crate::agent::{Agent, AgentError};
use crate::client::Observation;
use crate::planner::Plan;
use protocol::{Cell, Grid, Move};
use rayon::prelude::*;
use std::time::{Duration, Instant};

/// An agent at its world.
pub struct Robot {
    /// What estimates and plans.
    pub agent: Agent,
    observation: Observation,
    planning: Duration,
}

/// What a world shows after a step.
#[derive(Debug, Clone)]
pub struct Seen {
    /// Result and frame.
    pub observation: Observation,
    /// The hidden states X_k, shape `[H, W]`, where somebody knows them.
    pub truth: Option<Grid<u8>>,
}

/// What a step did to one robot, told between correction and prediction: its agent's belief is the posterior.
pub struct Turn<'a> {
    /// What the world showed before.
    pub before: Observation,
    /// The path that was flown.
    pub plan: Plan,
    /// The hidden states X_{k+1}, where somebody knows them.
    pub truth: Option<&'a Grid<u8>>,
}

impl Robot {
    /// An agent that has taken in all that its world shows: its belief is about X_{k+1}.
    pub fn resumed(agent: Agent, observation: Observation) -> Self {
        Self {
            agent,
            observation,
            planning: Duration::ZERO,
        }
    }

    /// An agent before its first frame takes in what its world shows.
    ///
    /// # Errors
    /// [`AgentError`] if the frame is impossible or the hidden states are missing.
    pub fn at(agent: Agent, seen: Seen) -> Result<Self, AgentError> {
        let mut robot = Self::resumed(agent, seen.observation);
        robot.correct(seen.truth.as_ref())?;
        robot.agent.predict();
        Ok(robot)
    }

    /// What its world shows.
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

    /// Puts in what the world shows by now, and corrects the belief; returns what it showed before.
    fn see(
        &mut self,
        seen: Observation,
        truth: Option<&Grid<u8>>,
    ) -> Result<Observation, AgentError> {
        let before = std::mem::replace(&mut self.observation, seen);
        self.correct(truth)?;
        Ok(before)
    }

    fn correct(&mut self, truth: Option<&Grid<u8>>) -> Result<(), AgentError> {
        self.agent.correct(&self.observation.frame, truth)
    }
}

/// One step of all robots. `robot` finds a run's own; `plan` chooses its path; `fly` flies all paths and gives what
/// each world shows then, in order; `look` is told of each robot's turn.
///
/// # Errors
/// Those of `fly`, and [`AgentError`] of the first agent that cannot take in what it sees.
pub fn step<R: Send, E: From<AgentError> + Send>(
    runs: &mut [R],
    robot: impl Fn(&mut R) -> &mut Robot + Sync,
    plan: impl Fn(&mut Robot) -> Plan + Sync,
    fly: impl FnOnce(&[Vec<Move>]) -> Result<Vec<Seen>, E>,
    look: impl Fn(&mut R, Turn<'_>) -> Result<(), AgentError> + Sync,
) -> Result<(), E> {
    let plans = in_parallel(runs.iter_mut(), |run| plan(robot(run)));
    let paths: Vec<Vec<Move>> = plans.iter().map(|plan| plan.moves.clone()).collect();
    let seen = fly(&paths)?;
    let turns = runs.iter_mut().zip(plans).zip(seen);
    let taken = in_parallel(turns, |((run, plan), Seen { observation, truth })| {
        let truth = truth.as_ref();
        let before = robot(run).see(observation, truth)?;
        look(
            run,
            Turn {
                before,
                plan,
                truth,
            },
        )?;
        robot(run).agent.predict();
        Ok(())
    });
    taken.into_iter().collect::<Result<(), AgentError>>()?;
    Ok(())
}

/// The results in order. One alone is worked on here: handing it to another thread costs more than it gains.
fn in_parallel<T: Send, U: Send>(
    tasks: impl Iterator<Item = T>,
    work: impl Fn(T) -> U + Sync,
) -> Vec<U> {
    let tasks: Vec<T> = tasks.collect();
    match tasks.len() {
        1 => tasks.into_iter().map(&work).collect(),
        _ => tasks.into_par_iter().map(&work).collect(),
    }
}
