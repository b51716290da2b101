//! The agent's side of one decision: plan for the objective asked, step, correct, predict.
//!
//! What [`crate::acting::run`] does with an objective of its own, one step at a time.

use crate::acting::handover::{leave, resume};
use crate::acting::registry::{self, Task};
use crate::acting::run::show;
use crate::config::AgentConfig;
use crate::estimation::belief::Belief;
use crate::estimation::summary::{summarise, summary_names};
use crate::learning::learned::Learned;
use crate::planning::Objective;
use crate::planning::policy::{EstimatorKind, PlannerKind, Policy};
use crate::rollout::agent::Agent;
use crate::rollout::{self, Robot, Seen};
use crate::server::client::{Client, Observation};
use crate::server::feed::Feed;
use anyhow::Result;
use protocol::Model;
use protocol::channels::Instance;
use protocol::control::WorldSeed;
use protocol::decisions::{AgentInfo, Decision};
use protocol::message::VERSION;
use std::os::fd::BorrowedFd;
use std::time::{Duration, Instant};

/// A lease is renewed when this part of its life has passed without use.
const RENEW_AFTER: u32 = 3;

/// Which world to decide for, and how.
#[derive(Debug, Clone)]
pub struct Assignment {
    pub instance: Instance,
    pub world: u32,
    /// Take the world from its holder.
    pub takeover: bool,
    /// What keeps the belief: the known model's filter, or the spatial one.
    pub estimator: EstimatorKind,
    /// What plans: beam search or shooting.
    pub planner: PlannerKind,
    pub config: AgentConfig,
}

/// A world, the belief about it, and the objectives that a decision chooses among.
pub struct Decider {
    client: Client,
    model: Model,
    prior: Belief,
    config: AgentConfig,
    choices: Vec<Policy>,
    robot: Robot,
    last: Decision,
    last_use: Instant,
    info: AgentInfo,
    feed: Feed,
}

impl Decider {
    /// Acquires the world where it stands and takes in its last frame.
    pub fn attach(task: &Assignment, model: Model, prior: Belief) -> Result<Self> {
        let (mut client, observation) =
            Client::acquire_one(&task.instance, task.world, task.takeover)?;
        let last_use = Instant::now();
        let choices = Policy::choices(task.estimator, task.planner, &model);
        let agent = agent(
            &client,
            &model,
            &prior,
            &task.config,
            &choices,
            &observation,
        )?;
        let mut robot = Robot::new(agent, observation);
        if !resume(&mut client, &mut robot)? {
            robot.begin(None, |_| ())?;
        }
        let feed = Feed::open(&task.instance, robot.agent.belief());
        let info = agent_info(task, &model, &choices, &client);
        let last = decision(&robot, &client, None);
        Ok(Self {
            client,
            model,
            prior,
            config: task.config.clone(),
            choices,
            robot,
            last,
            last_use,
            info,
            feed,
        })
    }

    pub fn info(&self) -> &AgentInfo {
        &self.info
    }

    /// Where the world and the belief stand.
    pub fn last(&self) -> &Decision {
        &self.last
    }

    /// Starts a new episode with a new belief.
    ///
    /// # Errors
    /// After a refusal everything is as it was.
    pub fn reset(&mut self, seed: Option<u64>) -> Result<&Decision> {
        let world = self.client.worlds().start;
        self.client.reset(&[WorldSeed { world, seed }])?;
        self.last_use = Instant::now();
        let observation = self.client.observe(self.client.worlds())?.remove(0);
        let agent = agent(
            &self.client,
            &self.model,
            &self.prior,
            &self.config,
            &self.choices,
            &observation,
        )?;
        self.robot = Robot::new(agent, observation);
        let feed = &mut self.feed;
        let look = |robot: &Robot| show(feed, world, robot, false);
        self.robot.begin(None, look)?;
        self.last = decision(&self.robot, &self.client, None);
        Ok(&self.last)
    }

    /// One step of the rollout, for an objective; `None` if there is no such objective.
    ///
    /// # Errors
    /// After a refusal everything is as it was.
    pub fn decide(&mut self, objective: u64) -> Result<Option<&Decision>> {
        let Some(target) = self.objective(objective) else {
            return Ok(None);
        };
        let world = self.client.worlds().start;
        rollout::step(
            std::slice::from_mut(&mut self.robot),
            |robot| robot,
            |robot| robot.plan_with(|agent, cell, step| agent.plan_for(target, cell, step)),
            |paths| {
                let observation = self.client.step(world..world + 1, paths)?.remove(0);
                self.last_use = Instant::now();
                let truth = None;
                anyhow::Ok(vec![Seen { observation, truth }])
            },
            |_, robot, _| {
                show(&mut self.feed, world, robot, false);
                Ok(())
            },
        )?;
        self.last = decision(&self.robot, &self.client, Some(objective));
        Ok(Some(&self.last))
    }

    /// How long until the lease wants to be renewed.
    pub fn until_renewal(&self, now: Instant) -> Duration {
        let lease = Duration::from_millis(self.client.info().lease_millis);
        (lease / RENEW_AFTER).saturating_sub(now.saturating_duration_since(self.last_use))
    }

    /// Checks that the server lives; renews the lease if it is time.
    pub fn keep_alive(&mut self, now: Instant) -> Result<()> {
        self.client.check_server()?;
        if self.until_renewal(now).is_zero() {
            self.client.renew()?;
            self.last_use = now;
        }
        Ok(())
    }

    /// The server's process: readable when it has ended.
    pub fn server_process(&self) -> BorrowedFd<'_> {
        self.client.server_process()
    }

    pub fn release(mut self) -> Result<()> {
        leave(&mut self.client, &self.robot)?;
        Ok(self.client.release()?)
    }

    fn objective(&self, index: u64) -> Option<Objective> {
        let choice = self.choices.get(usize::try_from(index).ok()?)?;
        Some(self.config.objective(choice))
    }
}

/// An agent before its first frame.
fn agent(
    client: &Client,
    model: &Model,
    prior: &Belief,
    config: &AgentConfig,
    choices: &[Policy],
    observation: &Observation,
) -> Result<Agent> {
    let task = Task {
        model,
        shape: client.shape(),
        n_moves: client.info().n_moves,
        prior,
        seed: config.planner_seed(observation.result.seed),
        learned: &Learned::default(),
    };
    // Any choice will do: each has the same estimator and planner.
    registry::agent(&choices[0], config, task)
}

fn decision(robot: &Robot, client: &Client, objective: Option<u64>) -> Decision {
    let observation = robot.observation();
    let result = &observation.result;
    Decision {
        step: result.step,
        reward: result.reward,
        n_target_cells: result.n_target_cells,
        n_visited: result.n_visited,
        n_hits: result.n_hits,
        robot: [result.row, result.col],
        terminated: result.terminated != 0,
        truncated: result.truncated != 0,
        seed: result.seed,
        episode: result.episode,
        objective,
        summary: summarise(
            robot.agent.belief(),
            observation.robot(),
            client.info().n_moves,
        ),
    }
}

fn agent_info(task: &Assignment, model: &Model, choices: &[Policy], client: &Client) -> AgentInfo {
    let server = client.info();
    AgentInfo {
        protocol: VERSION,
        build: env!("CARGO_PKG_VERSION").into(),
        pid: std::process::id(),
        instance: task.instance.name().into(),
        world: task.world,
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
