//! An agent that flies robots of one world through a connection: attach, step, catch up.

use crate::acting::handover::{catch_up, leave, resume, take_over_left};
use crate::acting::mission::{Company, Mission, info_of, model_of, recorded_states};
use crate::client::errors::is_late;
use crate::client::info::{connect, is_belief_left};
use crate::client::truth::TruthFeed;
use crate::client::view::view;
use anyhow::{Result, ensure};
use emberwatch_belief::estimation::Prior;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::planning::team::robot_seed;
use emberwatch_learning::estimation::first_belief::first_belief;
use emberwatch_learning::policy::{EstimatorKind, Policy};
use emberwatch_learning::registry::{self, Task, needs_model};
use emberwatch_learning::rollout::agent::Agent;
use emberwatch_learning::rollout::{Rollout, Seen};
use emberwatch_protocol::client::Observation;
use emberwatch_protocol::connection::ConnectionError;
use emberwatch_protocol::control::{ServerInfo, WorldSeed};
use emberwatch_protocol::feed::Feed;
use emberwatch_protocol::message::WorldResult;
use emberwatch_protocol::{Cell, Client, Grid, Model, Move};
use std::ops::Range;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Time between two warnings of steps that went on without the agent.
const WARN_INTERVAL: Duration = Duration::from_secs(10);

/// An agent at its world.
pub struct Pilot {
    client: Client,
    truth: Option<TruthFeed>,
    /// Knows all robots that are planned for, those that others fly among them.
    rollout: Rollout,
    /// Time that its last plan took.
    planning: Duration,
    model: Model,
    policy: Policy,
    /// The belief before an episode's first frame, once it was needed.
    prior: Option<Belief>,
    /// The numbers of these.
    seen: Range<u32>,
    feed: Feed,
    warned: Option<Instant>,
}

impl Pilot {
    /// Acquires the robots where their world stands and takes in its last frame.
    pub fn attach(mission: &Mission) -> Result<Self> {
        let info = info_of(&mission.instance, &mission.worlds())?;
        mission.check_task(&info)?;
        let numbers = mission.numbers(&info)?;
        let recorded = recorded_states(&info)?.filter(|_| mission.model.is_none());
        let is_recorded = recorded.is_some();
        let given = || model_of(&mission.instance, &info, mission.model.as_ref());
        let model = recorded.map_or_else(given, Ok)?;
        let policy = Policy::named(&mission.policy, &model)?;
        ensure!(
            !is_recorded || !policy.estimator.knows_model(),
            needs_model(&policy)
        );
        ensure!(
            policy.estimator != EstimatorKind::NextTruth,
            "policy {:?} needs worlds that run one step ahead: only `compare` has them",
            policy.name
        );
        ensure!(
            !policy.is_decided() || mission.company != Company::Team,
            "policy {:?} decides for one robot, not for a team",
            policy.name
        );
        if policy.estimator == EstimatorKind::Truth {
            check_truth(mission, &info)?;
        }
        let any = Belief::from_initial(&model, info.shape()?);
        let task = Task {
            model: &model,
            shape: any.shape(),
            n_moves: 1,
            prior: &any,
            seed: 0,
            learned: &mission.learned,
        };
        // Made first: an agent that lacks something must not take robots from one that flies them.
        let agent = registry::agent(&policy, &mission.config, task)?;
        // What takes long is done before the lease begins to run, and not at all where a belief was left.
        if let Some(kind) = agent
            .handover_kind()
            .filter(|_| policy.estimator.knows_model())
            && is_belief_left(&mission.instance, numbers.start, &kind)?
            && let Some(attached) = Self::go_on(mission, &numbers, &model, &policy, &any)?
        {
            return Ok(attached);
        }
        let prior = prior(mission, &info, &model, &policy)?;
        let mut attached = Self::acquire(mission, &numbers, &model, &policy, &prior)?;
        attached.prior = Some(prior);
        if !resume(&mut attached.client, numbers.start, &mut attached.rollout)? {
            attached.begin()?;
        }
        Ok(attached)
    }

    /// Acquires the robots and takes over the belief that was left for the first, in the place of `any`.
    fn go_on(
        mission: &Mission,
        numbers: &Range<u32>,
        model: &Model,
        policy: &Policy,
        any: &Belief,
    ) -> Result<Option<Self>> {
        let mut attached = Self::acquire(mission, numbers, model, policy, any)?;
        if take_over_left(&mut attached.client, numbers.start, &mut attached.rollout)? {
            return Ok(Some(attached));
        }
        // Another agent acted since.
        attached.client.release()?;
        Ok(None)
    }

    /// Acquires the robots for an agent before its first frame.
    fn acquire(
        mission: &Mission,
        numbers: &Range<u32>,
        model: &Model,
        policy: &Policy,
        prior: &Belief,
    ) -> Result<Self> {
        let connection = connect(&mission.instance)?;
        let mut client = Client::acquire(connection, &mission.claim(numbers))?;
        client.share_frames(mission.company != Company::Alone);
        let team = client.info().n_robots;
        let (robots, first) = match mission.company {
            Company::Team => (mission.world * team..(mission.world + 1) * team, 0),
            _ => (numbers.clone(), mission.robots.start),
        };
        let is_told = policy.estimator == EstimatorKind::Truth;
        let truth = is_told.then(|| open_truth(mission, &client)).transpose()?;
        let mut seen = Seen::new(client.observe(robots.clone())?);
        seen.truth = truth_of(truth.as_ref(), &client, &seen.observation.world)?;
        let (seed, step) = (seen.observation.world.seed, seen.observation.world.step);
        tracing::info!(
            world = mission.world,
            robots = ?mission.robots,
            seed,
            step,
            policy = policy.name,
            "acting"
        );
        let parts = (model, policy, prior);
        let agent = agent(mission, &client, parts, (seed, first))?;
        Ok(Self {
            truth,
            feed: Feed::open(&mission.instance, agent.belief().probabilities()),
            rollout: Rollout::new(agent, seen),
            planning: Duration::ZERO,
            model: model.clone(),
            policy: policy.clone(),
            prior: None,
            seen: robots,
            client,
            warned: None,
        })
    }

    fn begin(&mut self) -> Result<()> {
        self.rollout.correct()?;
        self.show(false);
        self.rollout.agent.predict();
        Ok(())
    }

    fn begin_next(&mut self, mission: &Mission) -> Result<()> {
        let prior = match self.prior.take() {
            Some(prior) => prior,
            None => prior(mission, self.client.info(), &self.model, &self.policy)?,
        };
        let (world, seed) = (mission.world, None);
        self.client.reset(&[WorldSeed { world, seed }])?;
        let seen = self.observe()?;
        let seed = seen.observation.world.seed;
        tracing::info!(world, seed, "the episode was truncated: the next begins");
        let first = self.seen.start % self.client.info().n_robots;
        let parts = (&self.model, &self.policy, &prior);
        let agent = agent(mission, &self.client, parts, (seed, first))?;
        self.rollout = Rollout::new(agent, seen);
        self.prior = Some(prior);
        self.begin()
    }

    /// One step of the rollout, of the next episode if one has ended; returns the reward, or `None` if no path was
    /// flown: it is time to stop, or the world has moved on without, and the agent has caught up. The last belief is
    /// shown in any case.
    pub fn step(
        &mut self,
        mission: &Mission,
        is_last: bool,
        stop: &AtomicBool,
    ) -> Result<Option<f64>> {
        if self.rollout.observation().world.truncated != 0 {
            self.begin_next(mission)?;
        }
        let paths = self.plan();
        let seen = match self.fly(&paths, stop) {
            Ok(Some(seen)) => seen,
            Ok(None) => return Ok(None),
            Err(error) if is_late(&error) => return self.catch_up().map(|()| None),
            Err(error) => return Err(error),
        };
        self.rollout.see(seen)?;
        self.show(is_last);
        self.rollout.agent.predict();
        let own = self.rollout.results().skip(self.own().start);
        let rewards = own.take(self.own().len()).map(|result| result.reward);
        Ok(Some(rewards.sum()))
    }

    /// Plans for its own robots and for those of others that flew; returns the paths of its own.
    fn plan(&mut self) -> Vec<Vec<Move>> {
        let start = Instant::now();
        let is_planned = self.is_planned();
        let cells = self.rollout.cells().into_iter().zip(&is_planned);
        let cells: Vec<Cell> = cells.filter(|(_, is)| **is).map(|(cell, _)| cell).collect();
        let step = self.rollout.step();
        let plans = self.rollout.agent.plan(&cells, step);
        self.planning = start.elapsed();
        let own = self.own();
        let n_before = is_planned[..own.start].iter().filter(|it| **it).count();
        let own = plans.into_iter().skip(n_before).take(own.len());
        own.map(|plan| plan.moves).collect()
    }

    /// Flies the paths; returns what the agent sees then, or `None` if it is time to stop.
    fn fly(&mut self, paths: &[Vec<Move>], stop: &AtomicBool) -> Result<Option<Seen>> {
        let is_over = || stop.load(Ordering::Relaxed);
        let answer = self
            .client
            .step_until(self.client.robots(), paths, &is_over)?;
        let Some(mut observations) = answer else {
            return Ok(None);
        };
        if self.seen.len() > observations.len() {
            let step = observations[0].world.step;
            observations = self.client.recall(self.seen.clone(), step)?;
        }
        self.with_truth(observations).map(Some)
    }

    /// What the world shows now.
    fn observe(&mut self) -> Result<Seen> {
        let observations = self.client.observe(self.seen.clone())?;
        self.with_truth(observations)
    }

    fn with_truth(&self, observations: Vec<Observation>) -> Result<Seen> {
        let mut seen = Seen::new(observations);
        seen.truth = truth_of(self.truth.as_ref(), &self.client, &seen.observation.world)?;
        Ok(seen)
    }

    /// Shows the posterior to observers, if it is time or in any case.
    fn show(&mut self, in_any_case: bool) {
        if self.feed.is_due() || in_any_case {
            let (robots, team) = (self.client.robots(), self.client.info().n_robots);
            let world = robots.start / team;
            let view = view(&self.rollout, world, robots, self.planning);
            self.feed.show(&view);
        }
    }

    /// Leaves the belief to the next agent of each robot.
    pub fn leave(&mut self) -> Result<(), ConnectionError> {
        let mut numbers = self.client.robots();
        numbers.try_for_each(|number| leave(&mut self.client, number, &self.rollout))
    }

    /// Gives the robots back, and ends when observers have had time to see the last belief.
    pub fn release(self) -> Result<(), ConnectionError> {
        let released = self.client.release();
        self.feed.end();
        released
    }

    /// Takes in what the world did meanwhile.
    fn catch_up(&mut self) -> Result<()> {
        let before = self.rollout.step();
        let seen = self.observe()?;
        let step = seen.observation.world.step;
        if self.warned.is_none_or(|at| at.elapsed() > WARN_INTERVAL) {
            self.warned = Some(Instant::now());
            tracing::warn!("late: the world went on from step {before} to {step}; catching up");
        }
        let number = self.seen.start;
        catch_up(&mut self.client, number, &mut self.rollout, seen)?;
        self.show(false);
        self.rollout.agent.predict();
        Ok(())
    }

    /// Which of the robots that it knows are its own.
    fn own(&self) -> Range<usize> {
        let own = self.client.robots();
        let index = |number: u32| (number - self.seen.start) as usize;
        index(own.start)..index(own.end)
    }

    /// For which of the robots that it knows it plans: its own, and those of others that flew.
    fn is_planned(&self) -> Vec<bool> {
        let (own, team) = (self.own(), self.client.info().n_robots);
        let hovered = self.rollout.observation().world.hovered;
        let is_planned = |(index, number): (usize, u32)| {
            own.contains(&index) || hovered >> (number % team) & 1 == 0
        };
        self.seen.clone().enumerate().map(is_planned).collect()
    }
}

fn prior(mission: &Mission, info: &ServerInfo, model: &Model, policy: &Policy) -> Result<Belief> {
    let prior = if policy.estimator.knows_model() {
        mission.config.prior(info.burn_in)
    } else {
        Prior::Initial
    };
    Ok(first_belief(
        prior,
        model,
        info.shape()?,
        mission.config.seed,
    )?)
}

/// An agent before its first frame, of a world's seed and the number of its first robot there.
fn agent(
    mission: &Mission,
    client: &Client,
    (model, policy, prior): (&Model, &Policy, &Belief),
    (seed, first): (u64, u32),
) -> Result<Agent> {
    let config = &mission.config;
    let task = Task {
        model,
        shape: client.shape(),
        n_moves: client.info().n_moves,
        prior,
        seed: robot_seed(config.planner_seed(seed), first as usize),
        learned: &mission.learned,
    };
    registry::agent(policy, config, task)
}

/// The hidden states that a world's robots see part of, for policies that are told them.
fn truth_of(
    feed: Option<&TruthFeed>,
    client: &Client,
    world: &WorldResult,
) -> Result<Option<Grid<u8>>> {
    let Some(feed) = feed else {
        return Ok(None);
    };
    let worlds = client.worlds_of(&client.robots());
    let states = feed.states(worlds, &[world.seed], world.step)?;
    Ok(states.into_iter().next())
}

fn open_truth(mission: &Mission, client: &Client) -> Result<TruthFeed> {
    check_truth(mission, client.info())?;
    TruthFeed::open(&mission.instance, client.shape())
}

fn check_truth(mission: &Mission, info: &ServerInfo) -> Result<()> {
    ensure!(
        info.publish_truth,
        "policy {:?} needs the truth channel: start the server with --publish-truth",
        mission.policy
    );
    Ok(())
}
