//! The agent's side of decisions: plan for the objectives asked, step, correct, predict.
//!
//! What [`crate::acting::run`] does with an objective of its own, one step at a time and in many worlds. Each has one
//! robot, so that worlds and robots have the same numbers.

use crate::acting::handover::{leave, resume};
use crate::acting::registry::{self, Task};
use crate::config::AgentConfig;
use crate::estimation::belief::Belief;
use crate::estimation::summary::{summarise, summary_names};
use crate::learning::learned::Learned;
use crate::planning::Objective;
use crate::planning::policy::{EstimatorKind, PlannerKind, Policy};
use crate::rollout::{self, Robot, Seen, in_parallel};
use crate::server::errors::refused;
use crate::server::feed::Feed;
use crate::server::info::connect;
use anyhow::Result;
use protocol::channels::Instance;
use protocol::client::{Claim, Observation};
use protocol::connection::ConnectionError;
use protocol::control::{ServerInfo, WorldSeed};
use protocol::decisions::{AgentInfo, Decision};
use protocol::message::{Status, VERSION};
use protocol::program::pid_namespace;
use protocol::{Client, Model, Move};
use std::ops::Range;
use std::os::fd::BorrowedFd;
use std::time::{Duration, Instant};

/// A lease is renewed when this part of its life has passed without use.
const RENEW_AFTER: u32 = 3;

/// Which worlds to decide for, and how.
#[derive(Debug, Clone)]
pub struct Assignment {
    pub instance: Instance,
    pub worlds: Range<u32>,
    pub takeover: bool,
    /// What keeps the beliefs: the known model's filter, or the spatial one.
    pub estimator: EstimatorKind,
    /// What plans: beam search or shooting.
    pub planner: PlannerKind,
    pub config: AgentConfig,
}

/// Worlds, the beliefs about them, and the objectives that a decision chooses among.
pub struct Decider {
    client: Client,
    model: Model,
    prior: Belief,
    config: AgentConfig,
    choices: Vec<Policy>,
    worlds: Vec<World>,
    last_use: Instant,
    info: AgentInfo,
    feed: Feed,
}

/// A world with its robot, and where the belief about it stands.
struct World {
    number: u32,
    robot: Robot,
    last: Decision,
}

impl Decider {
    /// Acquires the worlds where they stand and takes in their last frames.
    pub fn attach(task: &Assignment, model: Model, prior: Belief) -> Result<Self> {
        let claim = Claim {
            takeover: task.takeover,
            ..Claim::new(task.worlds.clone())
        };
        let mut client = Client::acquire(connect(&task.instance)?, &claim)?;
        let observations = client.observe(client.robots())?;
        let choices = Policy::choices(task.estimator, task.planner, &model.state_names());
        let mut decider = Self {
            last_use: Instant::now(),
            info: agent_info(task, &model, &choices, client.info()),
            feed: Feed::open(&task.instance, &prior),
            client,
            model,
            prior,
            config: task.config.clone(),
            choices,
            worlds: Vec::new(),
        };
        for (number, observation) in task.worlds.clone().zip(observations) {
            let mut robot = decider.robot(observation)?;
            if !resume(&mut decider.client, number, &mut robot)? {
                robot.begin(None, |_| ())?;
            }
            let last = decision(&robot, decider.n_moves(), None);
            decider.worlds.push(World {
                number,
                robot,
                last,
            });
        }
        Ok(decider)
    }

    pub fn info(&self) -> &AgentInfo {
        &self.info
    }

    /// Where each world and the belief about it stand.
    pub fn last(&self) -> Vec<Decision> {
        self.worlds.iter().map(|world| world.last.clone()).collect()
    }

    /// Starts new episodes with new beliefs in some worlds; the others stay as they are.
    ///
    /// # Errors
    /// After a refusal everything is as it was.
    pub fn reset(&mut self, seeds: &[WorldSeed]) -> Result<Vec<Decision>> {
        let worlds = self.client.robots();
        if let Some(other) = seeds.iter().find(|seed| !worlds.contains(&seed.world)) {
            return Err(no_such_world(&worlds, other.world).into());
        }
        self.client.reset(seeds)?;
        self.last_use = Instant::now();
        let observations = self.client.observe(worlds.clone())?;
        let shown = self.feed.turn(seeds.len());
        for (turn, &WorldSeed { world, .. }) in seeds.iter().enumerate() {
            let index = (world - worlds.start) as usize;
            let mut robot = self.robot(observations[index].clone())?;
            robot.begin(None, |robot| {
                if shown.contains(&turn) {
                    self.feed.show(&robot.view(world, world..world + 1));
                }
            })?;
            let last = decision(&robot, self.n_moves(), None);
            (self.worlds[index].robot, self.worlds[index].last) = (robot, last);
        }
        Ok(self.last())
    }

    /// One step of the rollout in each world that has an objective; the others stay as they are.
    ///
    /// # Errors
    /// After a refusal everything is as it was.
    pub fn decide(&mut self, objectives: &[Option<u64>]) -> Result<Vec<Decision>> {
        let targets = self.targets(objectives)?;
        let n_moves = self.n_moves();
        let runs = self.worlds.iter_mut().zip(&targets);
        let runs = runs.filter_map(|(world, target)| Some((world, (*target)?)));
        let mut runs: Vec<(&mut World, (u64, Objective))> = runs.collect();
        if runs.is_empty() {
            return Ok(self.last());
        }
        let worlds: Vec<u32> = runs.iter().map(|run| run.0.number).collect();
        let shown = self.feed.turn(runs.len());
        rollout::step(
            &mut runs,
            |(world, _)| &mut world.robot,
            |(world, (_, objective))| {
                let robot = &mut world.robot;
                robot.plan_with(|agent, robots, step| agent.plan_for(*objective, robots, step))
            },
            |paths| {
                let observations = step(&mut self.client, &worlds, paths)?;
                self.last_use = Instant::now();
                let seen = observations.into_iter();
                Ok(seen.map(|observation| Seen::new([observation])).collect())
            },
            |turn, (world, _), _| {
                if shown.contains(&turn) {
                    let number = world.number;
                    self.feed
                        .show(&world.robot.view(number, number..number + 1));
                }
                Ok(())
            },
        )?;
        in_parallel(runs.into_iter(), |(world, (asked, _))| {
            world.last = decision(&world.robot, n_moves, Some(asked));
        });
        Ok(self.last())
    }

    /// How long until the lease wants to be renewed.
    pub fn until_renewal(&self, now: Instant) -> Duration {
        let lease = Duration::from_millis(self.client.info().lease_millis);
        (lease / RENEW_AFTER).saturating_sub(now.saturating_duration_since(self.last_use))
    }

    /// Checks that the server lives; renews the lease if it is time.
    pub fn keep_alive(&mut self, now: Instant) -> Result<()> {
        self.client.connection().check_server()?;
        if self.until_renewal(now).is_zero() {
            self.client.renew()?;
            self.last_use = now;
        }
        Ok(())
    }

    /// The server's process: readable when it has ended.
    pub fn server_process(&self) -> BorrowedFd<'_> {
        self.client.connection().server_process()
    }

    pub fn release(mut self) -> Result<()> {
        for world in &self.worlds {
            leave(&mut self.client, world.number, &world.robot)?;
        }
        Ok(self.client.release()?)
    }

    fn n_moves(&self) -> usize {
        self.client.info().n_moves
    }

    /// A robot before it takes in what its world shows.
    fn robot(&self, observation: Observation) -> Result<Robot> {
        let task = Task {
            model: &self.model,
            shape: self.client.shape(),
            n_moves: self.n_moves(),
            prior: &self.prior,
            seed: self.config.planner_seed(observation.world.seed),
            learned: &Learned::default(),
        };
        // Any choice will do: each has the same estimator and planner.
        let agent = registry::agent(&self.choices[0], &self.config, task)?;
        Ok(Robot::new(agent, Seen::new([observation])))
    }

    /// What each world is to move for, if at all; all are checked before any moves.
    fn targets(&self, asked: &[Option<u64>]) -> Result<Vec<Option<(u64, Objective)>>> {
        let (expected, got) = (self.worlds.len(), asked.len());
        if got != expected {
            let problem = format!("objectives: expected {expected}, one a world, got {got}");
            let message = format!("{}: {problem}", Status::Malformed.explain(0));
            return Err(refused(Status::Malformed, 0, message).into());
        }
        let targets = self.worlds.iter().zip(asked).map(|(world, objective)| {
            let target = |index| Ok((index, self.target(world, index)?));
            objective.map(target).transpose()
        });
        targets.collect()
    }

    fn target(&self, world: &World, index: u64) -> Result<Objective, ConnectionError> {
        let choice = usize::try_from(index).ok();
        let Some(choice) = choice.and_then(|index| self.choices.get(index)) else {
            let (status, detail) = (Status::BadObjective, self.choices.len() as u64);
            let expected = status.explain(detail);
            let message = format!("{expected}, got {index} for world {}", world.number);
            return Err(refused(status, detail, message));
        };
        if world.robot.observation().world.truncated != 0 {
            let (status, detail) = (Status::EpisodeOver, world.number.into());
            return Err(refused(status, detail, status.explain(detail)));
        }
        Ok(self.config.objective(choice))
    }
}

/// Flies a path in each of these worlds, which ascend: one message for all that are consecutive.
fn step(
    client: &mut Client,
    worlds: &[u32],
    paths: &[Vec<Move>],
) -> Result<Vec<Observation>, ConnectionError> {
    let mut observations = Vec::with_capacity(worlds.len());
    for run in worlds.chunk_by(|world, next| world + 1 == *next) {
        let (first, n_worlds) = (run[0], run.len());
        let paths = &paths[observations.len()..][..n_worlds];
        observations.extend(client.step(first..first + n_worlds as u32, paths)?);
    }
    Ok(observations)
}

fn no_such_world(worlds: &Range<u32>, got: u32) -> ConnectionError {
    let (first, last) = (worlds.start, worlds.end - 1);
    let message = format!("no such world: the agent has worlds {first} to {last}, got {got}");
    refused(Status::NoSuchWorld, worlds.len() as u64, message)
}

fn decision(robot: &Robot, n_moves: usize, objective: Option<u64>) -> Decision {
    let observation = robot.observation();
    let (result, cell) = (&observation.world, observation.robot.cell());
    Decision {
        step: result.step,
        reward: result.reward,
        n_target_cells: result.n_target_cells,
        n_visited: result.n_visited,
        n_hits: result.n_hits,
        robot: [cell.row, cell.col].map(|index| index as u32),
        terminated: result.terminated != 0,
        truncated: result.truncated != 0,
        seed: result.seed,
        episode: result.episode,
        objective,
        summary: summarise(robot.agent.belief(), cell, n_moves),
    }
}

fn agent_info(
    task: &Assignment,
    model: &Model,
    choices: &[Policy],
    server: &ServerInfo,
) -> AgentInfo {
    AgentInfo {
        protocol: VERSION,
        build: env!("CARGO_PKG_VERSION").into(),
        pid: std::process::id(),
        pid_namespace: pid_namespace(),
        instance: task.instance.name().into(),
        first_world: task.worlds.start,
        n_worlds: task.worlds.len() as u32,
        height: server.height,
        width: server.width,
        n_moves: server.n_moves,
        max_steps: server.max_steps,
        states: model.state_names(),
        objectives: choices.iter().map(|choice| choice.name.clone()).collect(),
        estimator: task.estimator.label().into(),
        planner: task.planner.label().into(),
        summary: summary_names(model),
    }
}
