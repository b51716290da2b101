//! The agent's side of decisions: fly the options chosen, correct, predict, plan all options for the next choice.
//!
//! What [`crate::acting::run`] does with a policy of its own, one step at a time and in many worlds. Each has one
//! robot, so that worlds and robots have the same numbers.

use crate::acting::handover::{leave, resume};
use crate::acting::registry::{self, Task};
use crate::client::errors::refused;
use crate::client::feed::{Feed, View};
use crate::client::info::connect;
use crate::config::AgentConfig;
use crate::learning::learned::Learned;
use crate::policy::{EstimatorKind, PlannerKind, Policy};
use crate::rollout::agent::Agent;
use crate::rollout::{Rollout, Seen, in_parallel, see_all};
use anyhow::Result;
use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::planning::options::feature_names;
use emberwatch_belief::planning::{OPTIONS, Proposal, Target};
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::client::{Claim, Observation};
use emberwatch_protocol::connection::ConnectionError;
use emberwatch_protocol::control::{ServerInfo, WorldSeed};
use emberwatch_protocol::decisions::{AgentInfo, Decision};
use emberwatch_protocol::message::{Status, VERSION};
use emberwatch_protocol::program::pid_namespace;
use emberwatch_protocol::{Client, Model, Move};
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
    /// What keeps the beliefs.
    pub estimator: EstimatorKind,
    pub config: AgentConfig,
    /// What was learned, for estimators that it is for.
    pub learned: Learned,
}

/// Worlds, the beliefs about them, and the plans that a decision chooses among.
pub struct Decider {
    client: Client,
    crew: Crew,
    worlds: Vec<World>,
    last_use: Instant,
    info: AgentInfo,
    feed: Feed,
}

/// What robots are made of.
struct Crew {
    model: Model,
    prior: Belief,
    config: AgentConfig,
    learned: Learned,
    policy: Policy,
    n_moves: usize,
}

/// A world with its agent, and what it can fly next.
struct World {
    number: u32,
    rollout: Rollout,
    /// In the order of [`OPTIONS`].
    proposals: Vec<Proposal>,
    /// Time that they took.
    planning: Duration,
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
        let target = Target::State(model.target_state());
        let info = agent_info(task, &model, client.info());
        let crew = Crew {
            model,
            prior,
            config: task.config.clone(),
            learned: task.learned.clone(),
            policy: Policy::new("decisions", task.estimator, PlannerKind::Beam, target),
            n_moves: client.info().n_moves,
        };
        let feed = Feed::open(&task.instance, crew.agent(0)?.belief());
        let mut worlds = Vec::new();
        for (number, observation) in task.worlds.clone().zip(observations) {
            let mut rollout = crew.rollout(observation)?;
            if !resume(&mut client, number, &mut rollout)? {
                rollout.correct()?;
                rollout.agent.predict();
            }
            worlds.push(World::new(number, rollout));
        }
        Ok(Self {
            client,
            crew,
            worlds,
            last_use: Instant::now(),
            info,
            feed,
        })
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
            let mut rollout = self.crew.rollout(observations[index].clone())?;
            rollout.correct()?;
            if shown.contains(&turn) {
                let view = View::of(&rollout, world, world..world + 1, Duration::ZERO);
                self.feed.show(&view);
            }
            rollout.agent.predict();
            self.worlds[index] = World::new(world, rollout);
        }
        Ok(self.last())
    }

    /// One step of the rollout in each world that has an objective; the others stay as they are.
    ///
    /// # Errors
    /// After a refusal everything is as it was.
    pub fn decide(&mut self, objectives: &[Option<u64>]) -> Result<Vec<Decision>> {
        let choices = self.choices(objectives)?;
        let chosen = self.worlds.iter_mut().zip(&choices);
        let chosen = chosen.filter_map(|(world, choice)| Some((world, (*choice)?)));
        let mut chosen: Vec<(&mut World, usize)> = chosen.collect();
        if chosen.is_empty() {
            return Ok(self.last());
        }
        let worlds: Vec<u32> = chosen.iter().map(|(world, _)| world.number).collect();
        let paths = chosen
            .iter_mut()
            .map(|(world, choice)| world.take_up(*choice));
        let paths: Vec<Vec<Move>> = paths.collect();
        let observations = step(&mut self.client, &worlds, &paths)?;
        self.last_use = Instant::now();
        let seen = observations.into_iter();
        let seen = seen.map(|observation| Seen::new([observation])).collect();
        see_all(chosen.iter_mut().map(|(world, _)| &mut world.rollout), seen)?;
        for turn in self.feed.turn(worlds.len()) {
            let (world, _) = &chosen[turn];
            let robots = world.number..world.number + 1;
            let view = View::of(&world.rollout, world.number, robots, world.planning);
            self.feed.show(&view);
        }
        in_parallel(chosen, |(world, choice)| {
            world.rollout.agent.predict();
            world.look(Some(choice));
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
            leave(&mut self.client, world.number, &world.rollout)?;
        }
        Ok(self.client.release()?)
    }

    /// What each world is to fly, if anything; all are checked before any moves.
    fn choices(&self, asked: &[Option<u64>]) -> Result<Vec<Option<usize>>> {
        let (expected, got) = (self.worlds.len(), asked.len());
        if got != expected {
            let problem = format!("objectives: expected {expected}, one a world, got {got}");
            let message = format!("{}: {problem}", Status::Malformed.explain(0));
            return Err(refused(Status::Malformed, 0, message).into());
        }
        let choices = self.worlds.iter().zip(asked);
        let choices = choices
            .map(|(world, objective)| objective.map(|index| world.choice(index)).transpose());
        Ok(choices.collect::<Result<_, _>>()?)
    }
}

impl Crew {
    fn agent(&self, world_seed: u64) -> Result<Agent> {
        let task = Task {
            model: &self.model,
            shape: self.prior.shape(),
            n_moves: self.n_moves,
            prior: &self.prior,
            seed: self.config.planner_seed(world_seed),
            learned: &self.learned,
        };
        registry::agent(&self.policy, &self.config, task)
    }

    /// An agent before it takes in what its world shows.
    fn rollout(&self, observation: Observation) -> Result<Rollout> {
        let agent = self.agent(observation.world.seed)?;
        Ok(Rollout::new(agent, Seen::new([observation])))
    }
}

impl World {
    /// Where an agent has taken in what its world shows.
    fn new(number: u32, rollout: Rollout) -> Self {
        let mut world = Self {
            number,
            proposals: Vec::new(),
            planning: Duration::ZERO,
            last: decision(&rollout, None, &[]),
            rollout,
        };
        world.look(None);
        world
    }

    /// The option of a number.
    fn choice(&self, index: u64) -> Result<usize, ConnectionError> {
        let choice = usize::try_from(index).ok();
        let Some(choice) = choice.filter(|&choice| choice < OPTIONS.len()) else {
            let (status, detail) = (Status::BadObjective, OPTIONS.len() as u64);
            let expected = status.explain(detail);
            let message = format!("{expected}, got {index} for world {}", self.number);
            return Err(refused(status, detail, message));
        };
        if self.rollout.observation().world.truncated != 0 {
            let (status, detail) = (Status::EpisodeOver, self.number.into());
            return Err(refused(status, detail, status.explain(detail)));
        }
        Ok(choice)
    }

    /// The path of an option.
    fn take_up(&mut self, choice: usize) -> Vec<Move> {
        let proposal = self.proposals[choice].clone();
        self.rollout.agent.take_up(choice, proposal).moves
    }

    /// Takes in what the robot saw after a choice, and plans for the next.
    fn look(&mut self, choice: Option<usize>) {
        let start = Instant::now();
        let cell = self.rollout.observation().robot.cell();
        self.proposals = self.rollout.agent.propose(cell);
        self.planning = start.elapsed();
        self.last = decision(&self.rollout, choice, &self.proposals);
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

fn decision(rollout: &Rollout, choice: Option<usize>, proposals: &[Proposal]) -> Decision {
    let observation = rollout.observation();
    let (result, cell) = (&observation.world, observation.robot.cell());
    let features = proposals.iter().flat_map(|proposal| proposal.features);
    let features: Vec<u8> = features.flat_map(f32::to_le_bytes).collect();
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
        objective: choice.map(|choice| choice as u64),
        features: BASE64.encode(features),
    }
}

fn agent_info(task: &Assignment, model: &Model, server: &ServerInfo) -> AgentInfo {
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
        objectives: OPTIONS.iter().map(|option| option.name.into()).collect(),
        estimator: task.estimator.label(),
        features: feature_names(),
    }
}
