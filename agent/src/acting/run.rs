//! The agent's life on one world: attach, act, catch up, reconnect, leave.

use crate::acting::handover::{catch_up, leave, resume, take_over_left};
use crate::acting::registry::{self, Task};
use crate::config::AgentConfig;
use crate::estimation::Prior;
use crate::estimation::belief::Belief;
use crate::estimation::first_belief::first_belief;
use crate::learning::learned::Learned;
use crate::planning::policy::{EstimatorKind, Policy};
use crate::planning::team::robot_seed;
use crate::rollout::{self, Robot, Seen};
use crate::server::client::{
    Claim, Client, RETRY_INTERVAL, is_belief_left, is_late, is_outage, refusal, refused,
    server_info, shape_of,
};
use crate::server::feed::Feed;
use crate::server::truth::TruthFeed;
use anyhow::{Result, bail, ensure};
use protocol::channels::Instance;
use protocol::connection::ConnectionError;
use protocol::control::ServerInfo;
use protocol::message::{Status, WorldResult};
use protocol::{Grid, Model};
use std::cell::RefCell;
use std::ops::Range;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use thiserror::Error;

/// How often progress is told.
const REPORT_INTERVAL: Duration = Duration::from_secs(2);

/// Time between two warnings of steps that went on without the agent.
const WARN_INTERVAL: Duration = Duration::from_secs(10);

/// What to do on one world.
#[derive(Debug, Clone)]
pub struct Mission {
    pub instance: Instance,
    pub world: u32,
    /// Which robots of the world to fly, on one belief.
    pub robots: Range<u32>,
    /// See what all robots of the world see, those that others fly among them.
    pub shares_frames: bool,
    pub policy: String,
    /// Steps to act for; 0: until stopped.
    pub steps: u64,
    /// Take the robots from their holders.
    pub takeover: bool,
    /// The model, where the server does not reveal its own.
    pub model: Option<Model>,
    pub config: AgentConfig,
    /// What was learned, for policies that act on it.
    pub learned: Learned,
}

/// What a mission did.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Summary {
    pub steps: u64,
    /// Sum of their rewards, of all robots that it flew.
    pub reward: f64,
}

/// Acts until the steps are done or `stop` is set. Waits for a server that ends, however often.
pub fn run(mission: &Mission, stop: &AtomicBool) -> Result<Summary> {
    let (mut summary, mut is_in_step) = (Summary::default(), true);
    let mut attached = Attached::attach(mission)?;
    while !stop.load(Ordering::Relaxed) && (mission.steps == 0 || summary.steps < mission.steps) {
        match attached.step(summary.steps + 1 == mission.steps, stop) {
            Ok(Some(reward)) => {
                summary.steps += 1;
                summary.reward += reward;
                attached.report.tell(&summary);
            }
            Ok(None) => {}
            Err(error) if is_outage(&error) => {
                tracing::warn!("{error}; waiting for it to come back");
                match attach_again(mission, stop)? {
                    Some(again) => attached = again,
                    None => {
                        is_in_step = false;
                        break;
                    }
                }
            }
            Err(error) => return Err(error),
        }
    }
    let Attached {
        mut client,
        robot,
        feed,
        ..
    } = attached;
    // After an outage nobody knows where the world stands.
    let left = match is_in_step {
        true => leave_all(&mut client, &robot),
        false => Ok(()),
    };
    let released = left.and_then(|()| client.release());
    feed.end();
    match released.map_err(anyhow::Error::from) {
        Err(error) if !is_outage(&error) => Err(error),
        _ => Ok(summary),
    }
}

impl Mission {
    fn worlds(&self) -> Range<u32> {
        self.world..self.world.saturating_add(1)
    }

    /// The numbers of its robots on a server.
    fn numbers(&self, info: &ServerInfo) -> Result<Range<u32>> {
        let (robots, team) = (&self.robots, info.n_robots);
        ensure!(
            !robots.is_empty() && robots.end <= team,
            "robots: expected some of the world's 0..{team}, got {}..{}",
            robots.start,
            robots.end
        );
        Ok(self.world * team + robots.start..self.world * team + robots.end)
    }
}

/// Leaves the belief to the next agent of each robot.
fn leave_all(client: &mut Client, robot: &Robot) -> Result<(), ConnectionError> {
    let mut numbers = client.robots();
    numbers.try_for_each(|number| leave(client, number, robot))
}

/// An agent at its world.
struct Attached {
    client: Client,
    truth: Option<TruthFeed>,
    robot: Robot,
    feed: Feed,
    report: Report,
}

/// Tells of progress now and then.
struct Report {
    since: Instant,
    last: Summary,
    warned: Option<Instant>,
}

impl Attached {
    /// Acquires the robots where their world stands and takes in its last frame.
    fn attach(mission: &Mission) -> Result<Self> {
        let (info, model) = prepare(&mission.instance, &mission.worlds(), mission.model.as_ref())?;
        let policy = Policy::named(&mission.policy, &model)?;
        ensure!(
            policy.estimator != EstimatorKind::NextTruth,
            "policy {:?} needs worlds that run one step ahead: only `compare` has them",
            policy.name
        );
        ensure!(
            !policy.is_decided || mission.robots.len() == 1,
            "policy {:?} decides for one robot: expected one, got {}",
            policy.name,
            mission.robots.len()
        );
        let numbers = mission.numbers(&info)?;
        let shape = shape_of(&info)?;
        // What takes long is done before the lease begins to run, and not at all where a belief was left.
        let prior = if policy.estimator.knows_model() {
            let any = Belief::from_initial(&model, shape);
            if let Some(attached) = Self::go_on(mission, &numbers, &model, &policy, &any)? {
                return Ok(attached);
            }
            mission.config.prior(info.burn_in)
        } else {
            Prior::Initial
        };
        let prior = first_belief(prior, &model, shape, mission.config.seed)?;
        let mut attached = Self::acquire(mission, &numbers, &model, &policy, &prior)?;
        if !resume(&mut attached.client, numbers.start, &mut attached.robot)? {
            attached.begin()?;
        }
        Ok(attached)
    }

    /// Acquires the robots if a belief was left for the first, in the place of `any`.
    fn go_on(
        mission: &Mission,
        numbers: &Range<u32>,
        model: &Model,
        policy: &Policy,
        any: &Belief,
    ) -> Result<Option<Self>> {
        let task = Task {
            model,
            shape: any.shape(),
            n_moves: 1,
            prior: any,
            seed: 0,
            learned: &mission.learned,
        };
        let agent = registry::agent(policy, &mission.config, task)?;
        let Some(kind) = agent.estimator().kind() else {
            return Ok(None);
        };
        if !is_belief_left(&mission.instance, numbers.start, &kind)? {
            return Ok(None);
        }
        let mut attached = Self::acquire(mission, numbers, model, policy, any)?;
        if take_over_left(&mut attached.client, numbers.start, &mut attached.robot)? {
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
        let claim = Claim {
            robots: numbers.clone(),
            takeover: mission.takeover,
            time_to_live: None,
        };
        let mut client = Client::acquire(&mission.instance, &claim)?;
        // A team has one belief, of what all its robots see.
        client.share_frames(mission.shares_frames || numbers.len() > 1);
        let seen = Seen::new(client.observe(numbers.clone())?);
        let (seed, step) = (seen.observation.world.seed, seen.observation.world.step);
        tracing::info!(
            world = mission.world,
            robots = ?mission.robots,
            seed,
            step,
            policy = policy.name,
            "acting"
        );
        let task = Task {
            model,
            shape: client.shape(),
            n_moves: client.info().n_moves,
            prior,
            seed: robot_seed(
                mission.config.planner_seed(seed),
                mission.robots.start as usize,
            ),
            learned: &mission.learned,
        };
        let agent = registry::agent(policy, &mission.config, task)?;
        let is_told = policy.estimator == EstimatorKind::Truth;
        let truth = is_told.then(|| open_truth(mission, &client)).transpose()?;
        let feed = Feed::open(&mission.instance, agent.belief());
        let report = Report {
            since: Instant::now(),
            last: Summary::default(),
            warned: None,
        };
        Ok(Self {
            client,
            truth,
            robot: Robot::new(agent, seen),
            feed,
            report,
        })
    }

    fn begin(&mut self) -> Result<()> {
        let world = &self.robot.observation().world;
        let truth = truth_of(self.truth.as_ref(), &self.client, world)?;
        let (client, feed) = (&self.client, &mut self.feed);
        let look = |robot: &Robot| show(feed, client, robot, false);
        self.robot.begin(truth.as_ref(), look)
    }

    /// One step of the rollout; returns the reward, or `None` if no path was flown: it is time to stop, or the world has
    /// moved on without, and the agent has caught up. The last belief is shown in any case.
    fn step(&mut self, is_last: bool, stop: &AtomicBool) -> Result<Option<f64>> {
        let Self {
            client,
            truth,
            robot,
            feed,
            ..
        } = self;
        let (robots, mut is_flown) = (client.robots(), true);
        let client = RefCell::new(client);
        let stepped = rollout::step(
            std::slice::from_mut(robot),
            |robot| robot,
            Robot::plan,
            |paths| {
                let mut client = client.borrow_mut();
                let is_over = || stop.load(Ordering::Relaxed);
                let seen = client.step_until(robots, paths, &is_over)?;
                is_flown = seen.is_some();
                let mut seen = Seen::new(seen.ok_or(NotFlown)?);
                seen.truth = truth_of(truth.as_ref(), &client, &seen.observation.world)?;
                Ok(vec![seen])
            },
            |_, robot, _| {
                show(feed, &client.borrow(), robot, is_last);
                Ok(())
            },
        );
        match stepped {
            Ok(()) => Ok(Some(self.robot.results().map(|it| it.reward).sum())),
            Err(_) if !is_flown => Ok(None),
            Err(error) if is_late(&error) => self.catch_up().map(|()| None),
            Err(error) => Err(error),
        }
    }

    /// Takes in what the world did meanwhile.
    fn catch_up(&mut self) -> Result<()> {
        let robots = self.client.robots();
        let (number, before) = (robots.start, self.robot.observation().world.step);
        let mut seen = Seen::new(self.client.observe(robots)?);
        let step = seen.observation.world.step;
        self.report.warn_of(before, step);
        seen.truth = truth_of(self.truth.as_ref(), &self.client, &seen.observation.world)?;
        catch_up(&mut self.client, number, &mut self.robot, seen)?;
        show(&mut self.feed, &self.client, &self.robot, false);
        self.robot.agent.predict();
        Ok(())
    }
}

/// A path was not flown, as it was time to stop.
#[derive(Debug, Error)]
#[error("stopped")]
struct NotFlown;

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

/// Shows an agent's posterior to those who look on, if it is time or in any case.
fn show(feed: &mut Feed, client: &Client, robot: &Robot, in_any_case: bool) {
    if feed.is_due() || in_any_case {
        let (robots, team) = (client.robots(), client.info().n_robots);
        feed.show(&robot.view(robots.start / team, robots.start));
    }
}

impl Report {
    fn tell(&mut self, summary: &Summary) {
        let elapsed = self.since.elapsed();
        if elapsed < REPORT_INTERVAL {
            return;
        }
        let steps = summary.steps - self.last.steps;
        let mean_reward = (summary.reward - self.last.reward) / steps.max(1) as f64;
        let steps_per_second = (steps as f64 / elapsed.as_secs_f64()).round();
        tracing::info!(
            steps = summary.steps,
            mean_reward,
            steps_per_second,
            "acting"
        );
        self.since = Instant::now();
        self.last = *summary;
    }

    /// Says now and then that the world went on to a step without the agent.
    fn warn_of(&mut self, before: u64, step: u64) {
        if self.warned.is_none_or(|at| at.elapsed() > WARN_INTERVAL) {
            self.warned = Some(Instant::now());
            tracing::warn!("late: the world went on from step {before} to {step}; catching up");
        }
    }
}

/// What a server says of itself, and its model, or the one given; checks that it has the worlds.
pub fn prepare(
    instance: &Instance,
    worlds: &Range<u32>,
    model: Option<&Model>,
) -> Result<(ServerInfo, Model)> {
    let info = server_info(instance)?;
    if worlds.end > info.n_worlds {
        let (status, detail) = (Status::NoSuchWorld, info.n_worlds.into());
        return Err(refused(status, detail, status.explain(detail)).into());
    }
    let revealed = info.model.as_deref().map(Model::from_toml).transpose()?;
    let model = match (model, revealed) {
        (Some(given), Some(revealed)) if *given != revealed => {
            bail!(
                "model: expected the server's own, {:?}, as it reveals it, got another, {:?}",
                revealed.file().name,
                given.file().name
            );
        }
        (Some(given), _) => given.clone(),
        (None, Some(revealed)) => revealed,
        (None, None) => bail!(
            "instance {:?} does not reveal its model: expected --model FILE",
            instance.name()
        ),
    };
    let (expected, got) = (info.n_observations, model.file().observations.len());
    ensure!(
        got == expected,
        "model: expected the server's {expected} observations, got {got}"
    );
    Ok((info, model))
}

fn open_truth(mission: &Mission, client: &Client) -> Result<TruthFeed> {
    ensure!(
        client.info().publish_truth,
        "policy {:?} needs the truth channel: start the server with --publish-truth",
        mission.policy
    );
    TruthFeed::open(&mission.instance, client.shape())
}

/// Attaches to a server that has come back; `None` if it is time to stop.
fn attach_again(mission: &Mission, stop: &AtomicBool) -> Result<Option<Attached>> {
    let mut mission = mission.clone();
    mission.takeover = false;
    while !stop.load(Ordering::Relaxed) {
        match Attached::attach(&mission) {
            Ok(attached) => return Ok(Some(attached)),
            // The server did not end, it paused: our former connection holds the robots still.
            Err(error) if is_own_lease(&error) && !mission.takeover => mission.takeover = true,
            Err(error) if is_outage(&error) => {
                mission.takeover = false;
                std::thread::sleep(RETRY_INTERVAL);
            }
            Err(error) => return Err(error),
        }
    }
    Ok(None)
}

/// Whether a robot is taken by this very process.
fn is_own_lease(error: &anyhow::Error) -> bool {
    let own_pid = u64::from(std::process::id());
    refusal(error).is_some_and(|(status, detail, _)| (status, detail) == (Status::Busy, own_pid))
}
