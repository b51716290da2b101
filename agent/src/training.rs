//! Learns while acting: attach, fly, correct, learn, predict, save.
//!
//! The learner is told the grid, the number of observations and each path's reward and frame; the model that a server
//! may reveal is read only for decisions on the belief of a known model. One message steps all robots.
//! What is learned, and how it acts meanwhile, is a [`Learner`]'s.

mod events;
mod learners;
pub mod metrics;
mod spec;
pub mod tensorboard;

pub use self::spec::{CHECKPOINT, TrainingSpec};

use self::events::Events;
use self::learners::learner;
use crate::client::info::connect;
use crate::client::view::view;
use crate::training::metrics::{FROZEN, METRICS, Metrics};
use anyhow::{Result, bail};
use emberwatch_belief::estimation::scoring::Score;
use emberwatch_learning::checkpoint::{self, Contents};
use emberwatch_learning::learners::Learner;
use emberwatch_learning::update::{ModelUpdate, Tick};
use emberwatch_protocol::Client;
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::client::{Claim, Observation};
use emberwatch_protocol::connection::ConnectionError;
use emberwatch_protocol::control::WorldSeed;
use emberwatch_protocol::feed::Feed;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// The folder of a run without learning, for TensorBoard.
const FROZEN_EVENTS: &str = "frozen";

/// How often a checkpoint is written while training goes on.
const SAVE_INTERVAL: Duration = Duration::from_secs(30);

const REPORT_INTERVAL: Duration = Duration::from_secs(5);

/// The lease outlives a pause of this length, such as a slow disk's or that in which a prior is simulated.
const LEASE: Duration = Duration::from_secs(600);

#[derive(Debug, Clone, Default, PartialEq)]
pub struct TrainSummary {
    /// World steps acted, of all worlds together.
    pub steps: u64,
    /// Updates made, with those before a resume.
    pub updates: u64,
    pub reward: f64,
    pub times: Vec<(&'static str, Duration)>,
}

/// Trains on a server until the steps are done, the time is over or `stop` is set; saves in any case.
/// `contents`: what [`TrainingSpec::check`] gave.
pub fn train(
    instance: &Instance,
    spec: &TrainingSpec,
    contents: Option<Contents>,
    stop: &AtomicBool,
) -> Result<TrainSummary> {
    let mut training_loop = TrainingLoop::attach(instance, spec, contents)?;
    let outcome = training_loop.act(spec, stop);
    let saved = training_loop.save(spec);
    training_loop.summary.times = training_loop.learner.times();
    match (outcome, saved) {
        (Ok(()), saved) => saved?,
        (Err(problem), Ok(())) => return Err(problem),
        (Err(problem), Err(also)) => {
            bail!("{problem:#}; what was learned is lost: {also:#}");
        }
    }
    training_loop.warn_of_no_update(spec);
    training_loop.client.release()?;
    if let Some(feed) = training_loop.feed {
        feed.end();
    }
    Ok(training_loop.summary)
}

struct TrainingLoop {
    client: Client,
    learner: Box<dyn Learner>,
    metrics: Metrics,
    events: Events,
    feed: Option<Feed>,
    summary: TrainSummary,
    /// Updates before this run, of the runs that it resumes.
    n_before: u64,
    saved: Instant,
    told: Told,
}

/// What was told last, and what to tell next.
struct Told {
    at: Instant,
    steps: u64,
    reward: f64,
    score: Score,
}

impl TrainingLoop {
    fn attach(
        instance: &Instance,
        spec: &TrainingSpec,
        contents: Option<Contents>,
    ) -> Result<Self> {
        let place = spec.out.join(CHECKPOINT);
        if let Some(contents) = &contents {
            warn_of_other_settings(spec, contents)?;
        }
        let connection = connect(instance)?;
        let claim = Claim {
            robots: spec.robots(connection.info())?,
            takeover: spec.takeover,
            time_to_live: Some(LEASE),
        };
        let mut client = Client::acquire(connection, &claim)?;
        let mut learner = learner(spec, &client, contents.as_ref(), &place)?;
        let metrics = metrics(spec, &*learner)?;
        let events = events(spec, &*learner)?;
        if spec.freeze {
            learner.freeze();
        }
        let attached = learner.attach(running(&mut client)?);
        let n_gone_on = attached.map_err(|problem| spec.stopped(problem, &*learner))?;
        let n_new = client.robots().len() - n_gone_on;
        if spec.resume && n_new > 0 {
            let robots = n_new;
            tracing::info!(
                robots,
                "not where the checkpoint left them: beliefs begin again"
            );
        }
        let belief = learner.belief();
        let feed = belief.map(|(belief, _)| Feed::open(instance, belief.probabilities()));
        let now = Instant::now();
        Ok(Self {
            client,
            n_before: learner.n_updates(),
            learner,
            metrics,
            events,
            feed,
            summary: TrainSummary::default(),
            saved: now,
            told: Told::at(now, &TrainSummary::default()),
        })
    }

    fn act(&mut self, spec: &TrainingSpec, stop: &AtomicBool) -> Result<()> {
        let is_over = || spec.deadline.is_some_and(|end| Instant::now() >= end);
        let is_done = |steps: u64| spec.steps > 0 && steps >= spec.steps;
        while !is_done(self.summary.steps) && !stop.load(Ordering::Relaxed) && !is_over() {
            let tick = self.step();
            let tick = tick.map_err(|problem| spec.stopped(problem, &*self.learner))?;
            let updates = if spec.freeze {
                Ok(Vec::new())
            } else {
                self.learner.learn()
            };
            let mut updates = updates.map_err(|problem| spec.stopped(problem, &*self.learner))?;
            self.summary.updates = self.learner.n_updates();
            if updates.is_empty() {
                let n_more = self.learner.columns().len();
                updates.push(ModelUpdate::nothing(self.summary.updates, n_more));
            }
            self.metrics.add(&tick, &updates)?;
            self.events.add(&tick, &updates, &*self.learner)?;
            self.report(&tick, spec.steps);
            if self.saved.elapsed() > SAVE_INTERVAL {
                self.save(spec)?;
            }
        }
        Ok(())
    }

    /// One step of each robot; worlds at the end of their episodes begin again.
    fn step(&mut self) -> Result<Tick> {
        let start = Instant::now();
        let paths = self.learner.plan();
        let planning = start.elapsed() / paths.len().max(1) as u32;
        let robots = self.client.robots();
        let observations = if self.learner.wants_full_frames() {
            self.client.step_full(robots, &paths)?
        } else {
            self.client.step(robots, &paths)?
        };
        let over = ended(&self.client, &observations);
        let tick = self.learner.see(observations)?;
        self.show(planning);
        self.learner.predict();
        for (robot, observation) in reset(&mut self.client, &over)? {
            self.learner.begin(robot, observation)?;
        }
        self.summary.steps += tick.n_worlds;
        self.summary.reward += tick.reward;
        Ok(tick)
    }

    /// Shows the posteriors of the robots whose turn it is; `planning`: time that a plan took.
    fn show(&mut self, planning: Duration) {
        let (robots, team) = (self.client.robots(), self.client.info().n_robots);
        let Some(feed) = &mut self.feed else {
            return;
        };
        for index in feed.turn(robots.len()) {
            let (number, rollout) = (robots.start + index as u32, self.learner.rollout(index));
            let mut view = view(rollout, number / team, number..number + 1, planning);
            view.intent.policy = format!("train {}", self.learner.kind());
            feed.show(&view);
        }
    }

    /// Writes the checkpoint, unless nothing is learned, and the metrics.
    fn save(&mut self, spec: &TrainingSpec) -> Result<()> {
        self.saved = Instant::now();
        if !spec.freeze {
            let contents = self.learner.contents();
            let mut contents = contents.map_err(|error| spec.stopped(error, &*self.learner))?;
            contents.settings = toml::to_string(&spec.config)?;
            let place = spec.out.join(CHECKPOINT);
            checkpoint::write(&place, self.learner.kind(), &contents)?;
        }
        self.metrics.flush()?;
        self.events.flush()
    }

    /// Warns of a run that was to learn and did not.
    fn warn_of_no_update(&self, spec: &TrainingSpec) {
        let steps = self.summary.steps;
        if !spec.freeze && steps > 0 && self.learner.n_updates() == self.n_before {
            let cause = self.learner.lacks(steps);
            tracing::warn!("nothing was learned in {steps} world steps: {cause}");
        }
    }

    fn report(&mut self, tick: &Tick, all_steps: u64) {
        let told = &mut self.told;
        told.score += tick.score;
        if told.at.elapsed() < REPORT_INTERVAL {
            return;
        }
        let steps = self.summary.steps - told.steps;
        let before = tick.world_steps - self.summary.steps;
        let of = (all_steps > 0).then_some(before + all_steps);
        tracing::info!(
            world_steps = tick.world_steps,
            of = of,
            updates = self.learner.n_updates(),
            log_likelihood = told.score.mean(),
            mean_reward = (self.summary.reward - told.reward) / steps.max(1) as f64,
            "training"
        );
        *told = Told::at(Instant::now(), &self.summary);
    }
}

impl Told {
    fn at(at: Instant, summary: &TrainSummary) -> Self {
        Self {
            at,
            steps: summary.steps,
            reward: summary.reward,
            score: Score::default(),
        }
    }
}

fn warn_of_other_settings(spec: &TrainingSpec, contents: &Contents) -> Result<()> {
    if toml::to_string(&spec.config)? != contents.settings {
        tracing::warn!(
            "settings: other than the checkpoint was trained with; these hold from here on"
        );
    }
    Ok(())
}

/// What the client's robots show, in new episodes where the last ones have ended.
fn running(client: &mut Client) -> Result<Vec<Observation>, ConnectionError> {
    let mut observations = client.observe(client.robots())?;
    let over = ended(client, &observations);
    for (robot, seen) in reset(client, &over)? {
        observations[(robot - client.robots().start) as usize] = seen;
    }
    Ok(observations)
}

fn is_over(seen: &Observation) -> bool {
    seen.world.truncated != 0 || seen.world.terminated != 0
}

/// The worlds whose episodes have ended, by what the client's robots show.
fn ended(client: &Client, observations: &[Observation]) -> Vec<u32> {
    let robots = client.robots().zip(observations);
    let over = robots.filter(|(_, seen)| is_over(seen));
    let mut worlds: Vec<u32> = over
        .map(|(robot, _)| robot / client.info().n_robots)
        .collect();
    worlds.dedup();
    worlds
}

/// Starts the next episode of some worlds; returns what each of their robots shows.
fn reset(client: &mut Client, worlds: &[u32]) -> Result<Vec<(u32, Observation)>, ConnectionError> {
    if worlds.is_empty() {
        return Ok(Vec::new());
    }
    let seeds = worlds.iter().map(|&world| WorldSeed { world, seed: None });
    client.reset(&seeds.collect::<Vec<_>>())?;
    let (team, mut seen) = (client.info().n_robots, Vec::new());
    for world in worlds {
        let robots = world * team..(world + 1) * team;
        seen.extend(robots.clone().zip(client.observe(robots)?));
    }
    Ok(seen)
}

/// The file of metrics: a run without learning has one of its own.
fn metrics(spec: &TrainingSpec, learner: &dyn Learner) -> Result<Metrics> {
    let (columns, world_steps) = (learner.columns(), learner.world_steps());
    match (spec.freeze, spec.resume) {
        (true, _) => Metrics::begin(&spec.out.join(FROZEN), columns),
        (false, true) => Metrics::go_on(&spec.out.join(METRICS), columns, world_steps),
        (false, false) => Metrics::begin(&spec.out.join(METRICS), columns),
    }
}

/// The file of TensorBoard's events: a run without learning has a folder of its own, and begins again.
fn events(spec: &TrainingSpec, learner: &dyn Learner) -> Result<Events> {
    match (spec.freeze, spec.resume) {
        (true, _) => Events::begin(&spec.out.join(FROZEN_EVENTS), 0),
        (false, true) => Events::begin(&spec.out, learner.world_steps()),
        (false, false) => Events::begin(&spec.out, 0),
    }
}
