//! An agent that flies robots of one world through a connection: attach, step, catch up.

use crate::acting::handover::{catch_up, leave, resume, take_over_left};
use crate::acting::link::Link;
use crate::acting::mission::{Mission, info_of, model_of, needs_model, recorded_states};
use crate::acting::team::Team;
use crate::client::errors::is_late;
use crate::client::info::{connect, is_belief_left, warn_of_other_worlds};
use crate::client::view::view;
use anyhow::{Result, ensure};
use emberwatch_acting::beliefs::first_belief::first_belief;
use emberwatch_acting::beliefs::{Conditions, Input, WorldForm};
use emberwatch_acting::policy::Policy;
use emberwatch_acting::rollout::agent::Agent;
use emberwatch_acting::rollout::{
    self, ActingAgent, Actor, AgentObservation, StepRecord, building,
};
use emberwatch_belief::estimation::Prior;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::planning::team::robot_seed;
use emberwatch_protocol::connection::ConnectionError;
use emberwatch_protocol::control::{ServerInfo, WorldSeed};
use emberwatch_protocol::feed::Feed;
use emberwatch_protocol::{Cell, Client, Model, Move};
use std::ops::Range;
use std::time::{Duration, Instant};

const WARN_INTERVAL: Duration = Duration::from_secs(10);

/// An agent that holds the lease on robots of one world.
pub struct Pilot {
    link: Link,
    flyer: Flyer,
    model: Model,
    policy: Policy,
    prior: Option<Belief>,
    warned: Option<Instant>,
}

struct Flyer {
    acting: ActingAgent,
    /// Numbers on the server of all robots that the agent plans for.
    robots: Range<u32>,
    /// Numbers on the server of the robots that it flies.
    own: Range<u32>,
    team: u32,
    planning: Duration,
    feed: Feed,
    /// Whether the next belief is the last one. The last belief is always published.
    is_last: bool,
}

impl Pilot {
    /// Acquires the robots in the present state of their world, and updates the belief with the world's latest frame.
    pub fn attach(mission: &Mission) -> Result<Self> {
        let info = info_of(&mission.instance, &mission.worlds())?;
        let numbers = mission.numbers(&info)?;
        let recorded = recorded_states(&info)?.filter(|_| mission.model.is_none());
        let is_recorded = recorded.is_some();
        let given = || model_of(&mission.instance, &info, mission.model.as_ref());
        let model = recorded.map_or_else(given, Ok)?;
        let policy = Policy::named(&mission.policy, &model)?;
        // An agent that cannot act must not take robots over from an agent that can.
        check(mission, &info, (&model, &policy), is_recorded)?;
        warn_of_other_worlds(&mission.learned, &info);
        // Simulating the prior can take long, so it happens before the lease begins. The simulation is skipped if a
        // former agent left a belief.
        let any = Belief::from_initial(&model, info.shape()?);
        if policy.belief.knows_model
            && let Some(kind) =
                agent(mission, &info, (&model, &policy, &any), (0, 0))?.handover_kind()
            && is_belief_left(&mission.instance, numbers.start, &kind)?
            && let Some(attached) = Self::continue_left(mission, &numbers, (&model, &policy, &any))?
        {
            return Ok(attached);
        }
        let prior = prior(mission, &info, &model, &policy)?;
        let mut attached = Self::acquire(mission, &numbers, (&model, &policy, &prior))?;
        attached.prior = Some(prior);
        let (client, acting) = (&mut attached.link.client, &mut attached.flyer.acting);
        if !resume(client, numbers.start, acting)? {
            attached.start_episode()?;
        }
        Ok(attached)
    }

    /// Acquires the robots and takes over the belief left for the first robot; the agent is built with any prior.
    /// Returns `None` if the belief is outdated.
    fn continue_left(
        mission: &Mission,
        numbers: &Range<u32>,
        parts: (&Model, &Policy, &Belief),
    ) -> Result<Option<Self>> {
        let mut attached = Self::acquire(mission, numbers, parts)?;
        let (client, acting) = (&mut attached.link.client, &mut attached.flyer.acting);
        if take_over_left(client, numbers.start, acting)? {
            return Ok(Some(attached));
        }
        // Another agent has acted since the belief was found.
        attached.link.client.release()?;
        Ok(None)
    }

    fn acquire(
        mission: &Mission,
        numbers: &Range<u32>,
        parts @ (model, policy, _): (&Model, &Policy, &Belief),
    ) -> Result<Self> {
        let connection = connect(&mission.instance)?;
        let mut client = Client::acquire(connection, &mission.claim(numbers))?;
        client.share_frames(mission.team != Team::Alone);
        let team = client.info().n_robots;
        let robots = match mission.team {
            Team::Joint => mission.world * team..(mission.world + 1) * team,
            _ => numbers.clone(),
        };
        let sees_truth = policy.belief.input == Input::States;
        let mut link = Link::new(client, mission, robots.clone(), sees_truth)?;
        let seen = link.observe()?;
        let (seed, step) = (seen.observation.world.seed, seen.observation.world.step);
        tracing::info!(
            world = mission.world,
            robots = ?mission.robots,
            seed,
            step,
            policy = policy.name,
            "acting"
        );
        let agent = agent(
            mission,
            link.client.info(),
            parts,
            (seed, robots.start % team),
        )?;
        let flyer = Flyer {
            feed: Feed::open(&mission.instance, agent.belief().probabilities()),
            acting: ActingAgent::new(agent, seen),
            robots,
            own: link.client.robots(),
            team,
            planning: Duration::ZERO,
            is_last: false,
        };
        Ok(Self {
            link,
            flyer,
            model: model.clone(),
            policy: policy.clone(),
            prior: None,
            warned: None,
        })
    }

    fn start_episode(&mut self) -> Result<()> {
        self.flyer.acting.correct()?;
        self.flyer.show();
        self.flyer.acting.agent.predict();
        Ok(())
    }

    fn start_next_episode(&mut self, mission: &Mission) -> Result<()> {
        let prior = match self.prior.take() {
            Some(prior) => prior,
            None => prior(mission, self.link.client.info(), &self.model, &self.policy)?,
        };
        let (world, seed) = (mission.world, None);
        self.link.client.reset(&[WorldSeed { world, seed }])?;
        let seen = self.link.observe()?;
        let seed = seen.observation.world.seed;
        tracing::info!(
            world,
            seed,
            "the episode was truncated: the next one starts"
        );
        let first = self.flyer.robots.start % self.flyer.team;
        let parts = (&self.model, &self.policy, &prior);
        let agent = agent(mission, self.link.client.info(), parts, (seed, first))?;
        self.flyer.acting = ActingAgent::new(agent, seen);
        self.prior = Some(prior);
        self.start_episode()
    }

    /// Flies one step, in the next episode if the last one has ended. Returns the reward. Returns `None` if no path was
    /// flown, either because the agent must stop, or because the world stepped without the agent, which then catches up.
    /// The belief after the last step is always published.
    pub fn step(&mut self, mission: &Mission, is_last: bool) -> Result<Option<f64>> {
        if self.flyer.acting.observation().world.truncated != 0 {
            self.start_next_episode(mission)?;
        }
        self.flyer.is_last = is_last;
        match rollout::step(&mut self.flyer, &mut self.link) {
            Ok(flown) => Ok(flown.map(|_| self.flyer.reward())),
            Err(error) if is_late(&error) => self.catch_up().map(|()| None),
            Err(error) => Err(error),
        }
    }

    /// Leaves the belief for the next agent of each robot.
    pub fn leave(&mut self) -> Result<(), ConnectionError> {
        let mut numbers = self.flyer.own.clone();
        numbers.try_for_each(|number| leave(&mut self.link.client, number, &self.flyer.acting))
    }

    /// Releases the robots. Returns only after observers have had time to see the last belief.
    pub fn release(self) -> Result<(), ConnectionError> {
        let released = self.link.client.release();
        self.flyer.feed.end();
        released
    }

    fn catch_up(&mut self) -> Result<()> {
        let before = self.flyer.acting.step();
        let seen = self.link.observe()?;
        let step = seen.observation.world.step;
        if self.warned.is_none_or(|at| at.elapsed() > WARN_INTERVAL) {
            self.warned = Some(Instant::now());
            tracing::warn!("late: the world advanced from step {before} to {step}; catching up");
        }
        let (client, acting) = (&mut self.link.client, &mut self.flyer.acting);
        catch_up(client, self.flyer.robots.start, acting, seen)?;
        self.flyer.is_last = false;
        self.flyer.show();
        self.flyer.acting.agent.predict();
        Ok(())
    }
}

impl Actor for Flyer {
    fn plan(&mut self) -> Vec<Vec<Move>> {
        let start = Instant::now();
        let is_planned = self.is_planned();
        let cells = self.acting.cells().into_iter().zip(&is_planned);
        let cells: Vec<Cell> = cells.filter(|(_, is)| **is).map(|(cell, _)| cell).collect();
        let step = self.acting.step();
        let plans = self.acting.agent.plan(&cells, step);
        self.planning = start.elapsed();
        let own = self.own_indices();
        let n_before = is_planned[..own.start].iter().filter(|it| **it).count();
        let own = plans.into_iter().skip(n_before).take(own.len());
        own.map(|plan| plan.moves).collect()
    }

    fn see(&mut self, seen: Vec<AgentObservation>) -> Result<Vec<StepRecord>> {
        let seen = seen.into_iter().map(|seen| self.acting.see(seen));
        let records = seen.collect::<Result<_>>()?;
        self.show();
        Ok(records)
    }

    fn predict(&mut self) {
        self.acting.agent.predict();
    }
}

impl Flyer {
    fn show(&mut self) {
        if self.feed.is_due() || self.is_last {
            let world = self.own.start / self.team;
            let view = view(&self.acting, world, self.own.clone(), self.planning);
            self.feed.show(&view);
        }
    }

    fn reward(&self) -> f64 {
        let own = self.own_indices();
        let results = self.acting.results().skip(own.start).take(own.len());
        results.map(|result| result.reward).sum()
    }

    fn own_indices(&self) -> Range<usize> {
        let index = |number: u32| (number - self.robots.start) as usize;
        index(self.own.start)..index(self.own.end)
    }

    fn is_planned(&self) -> Vec<bool> {
        let (own, team) = (self.own_indices(), self.team);
        let hovered = self.acting.observation().world.hovered;
        let is_planned = |(index, number): (usize, u32)| {
            own.contains(&index) || hovered >> (number % team) & 1 == 0
        };
        self.robots.clone().enumerate().map(is_planned).collect()
    }
}

fn check(
    mission: &Mission,
    info: &ServerInfo,
    (model, policy): (&Model, &Policy),
    is_recorded: bool,
) -> Result<()> {
    ensure!(
        !is_recorded || !policy.belief.knows_model,
        needs_model(policy)
    );
    ensure!(
        policy.belief.input != Input::States || info.publish_truth,
        "policy {:?} needs the truth channel: start the server with --publish-truth",
        mission.policy
    );
    building::check(
        policy,
        &mission.learned,
        &WorldForm::of(model, info.shape()?),
    )
}

fn prior(mission: &Mission, info: &ServerInfo, model: &Model, policy: &Policy) -> Result<Belief> {
    let prior = if policy.belief.knows_model {
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

fn agent(
    mission: &Mission,
    info: &ServerInfo,
    (model, policy, prior): (&Model, &Policy, &Belief),
    (seed, first): (u64, u32),
) -> Result<Agent> {
    let config = &mission.config;
    let conditions = Conditions {
        model: Some(model),
        shape: info.shape()?,
        prior: Some(prior),
        learned: &mission.learned,
    };
    let seed = robot_seed(config.planner_seed(seed), first as usize);
    building::agent(policy, config, &conditions, info.n_moves, seed)
}
