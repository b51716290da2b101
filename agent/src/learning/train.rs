//! Learns while acting: attach, fly, correct, learn, predict, save.
//!
//! The learner is told the grid, the number of observations and each path's reward and frame; the
//! model that a server may reveal is read only where decisions are learned. One message steps all robots.
//! What is learned, and how it acts meanwhile, is a [`Student`]'s.

mod events;
mod students;
mod training;

pub use self::training::{CHECKPOINT, Training};

use self::events::Events;
use self::students::student;
use crate::estimation::scoring::Score;
use crate::learning::checkpoint::{self, Contents};
use crate::learning::metrics::{FROZEN, METRICS, Metrics, ModelUpdate, Tick};
use crate::learning::student::Student;
use crate::rollout::Robot;
use crate::server::feed::Feed;
use crate::server::info::connect;
use anyhow::{Result, bail};
use protocol::channels::Instance;
use protocol::client::{Claim, Observation};
use protocol::connection::ConnectionError;
use protocol::control::WorldSeed;
use protocol::{Client, Move};
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
/// `contents`: what [`Training::check`] gave.
pub fn train(
    instance: &Instance,
    training: &Training,
    contents: Option<Contents>,
    stop: &AtomicBool,
) -> Result<TrainSummary> {
    let mut trainer = Trainer::attach(instance, training, contents)?;
    let deadline = training.time_limit.map(|limit| Instant::now() + limit);
    let outcome = trainer.act(training, stop, deadline);
    let saved = trainer.save(training);
    trainer.summary.times = trainer.student.times();
    match (outcome, saved) {
        (Ok(()), saved) => saved?,
        (Err(problem), Ok(())) => return Err(problem),
        (Err(problem), Err(also)) => {
            bail!("{problem:#}; what was learned is lost: {also:#}");
        }
    }
    trainer.client.release()?;
    if let Some(feed) = trainer.feed {
        feed.end();
    }
    Ok(trainer.summary)
}

struct Trainer {
    client: Client,
    student: Box<dyn Student>,
    metrics: Metrics,
    events: Events,
    feed: Option<Feed>,
    summary: TrainSummary,
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

impl Trainer {
    fn attach(
        instance: &Instance,
        training: &Training,
        contents: Option<Contents>,
    ) -> Result<Self> {
        let place = training.out.join(CHECKPOINT);
        let connection = connect(instance)?;
        let claim = Claim {
            robots: training.robots(connection.info())?,
            takeover: training.takeover,
            time_to_live: Some(LEASE),
        };
        let mut client = Client::acquire(connection, &claim)?;
        let mut student = student(training, &client, contents.as_ref(), &place)?;
        let metrics = metrics(training, &*student)?;
        let events = events(training, &*student)?;
        if training.freeze {
            student.freeze();
        }
        let mut observations = client.observe(client.robots())?;
        let over = ended(&client, &observations);
        for (robot, seen) in reset(&mut client, &over)? {
            observations[(robot - client.robots().start) as usize] = seen;
        }
        let attached = student.attach(observations);
        let n_gone_on = attached.map_err(|problem| training.stopped(problem, &*student))?;
        let n_new = client.robots().len() - n_gone_on;
        if training.resume && n_new > 0 {
            let robots = n_new;
            tracing::info!(
                robots,
                "not where the checkpoint left them: beliefs begin again"
            );
        }
        let belief = student.belief();
        let feed = belief.map(|(belief, _)| Feed::open(instance, belief));
        let now = Instant::now();
        Ok(Self {
            client,
            student,
            metrics,
            events,
            feed,
            summary: TrainSummary::default(),
            saved: now,
            told: Told::at(now, &TrainSummary::default()),
        })
    }

    fn act(
        &mut self,
        training: &Training,
        stop: &AtomicBool,
        deadline: Option<Instant>,
    ) -> Result<()> {
        let is_over = || deadline.is_some_and(|deadline| Instant::now() >= deadline);
        let is_done = |steps: u64| training.steps > 0 && steps >= training.steps;
        while !is_done(self.summary.steps) && !stop.load(Ordering::Relaxed) && !is_over() {
            let tick = self.step();
            let tick = tick.map_err(|problem| training.stopped(problem, &*self.student))?;
            let updates = match training.freeze {
                true => Ok(Vec::new()),
                false => self.student.learn(),
            };
            let mut updates =
                updates.map_err(|problem| training.stopped(problem, &*self.student))?;
            self.summary.updates = self.student.n_updates();
            if updates.is_empty() {
                let n_more = self.student.columns().len();
                updates.push(ModelUpdate::nothing(self.summary.updates, n_more));
            }
            self.metrics.add(&tick, &updates)?;
            self.events.add(&tick, &updates, &*self.student)?;
            self.report(&tick, training.steps);
            if self.saved.elapsed() > SAVE_INTERVAL {
                self.save(training)?;
            }
        }
        Ok(())
    }

    /// One step of each robot; worlds at the end of their episodes begin again.
    fn step(&mut self) -> Result<Tick> {
        let Self {
            client,
            student,
            feed,
            ..
        } = self;
        let (robots, wants_full) = (client.robots(), student.wants_full_frames());
        let shown = feed
            .as_ref()
            .map_or_else(Vec::new, |feed| feed.turn(robots.len()));
        let policy = format!("train {}", student.kind());
        let (team, mut over) = (client.info().n_robots, Vec::new());
        let mut fly = |paths: &[Vec<Move>]| {
            let observations = match wants_full {
                true => client.step_full(robots.clone(), paths)?,
                false => client.step(robots.clone(), paths)?,
            };
            over = ended(client, &observations);
            Ok(observations)
        };
        let mut look = |index: usize, robot: &Robot| {
            if let Some(feed) = feed.as_mut().filter(|_| shown.contains(&index)) {
                let number = robots.start + index as u32;
                let mut view = robot.view(number / team, number..number + 1);
                view.intent.policy.clone_from(&policy);
                feed.show(&view);
            }
        };
        let tick = student.step(&mut fly, &mut look)?;
        for (robot, observation) in reset(client, &over)? {
            student.begin(robot, observation)?;
        }
        self.summary.steps += tick.n_worlds;
        self.summary.reward += tick.reward;
        Ok(tick)
    }

    /// Writes the checkpoint, unless nothing is learned, and the metrics.
    fn save(&mut self, training: &Training) -> Result<()> {
        self.saved = Instant::now();
        if !training.freeze {
            let contents = self.student.contents();
            let mut contents = contents.map_err(|error| training.stopped(error, &*self.student))?;
            contents.settings = toml::to_string(&training.config)?;
            let place = training.out.join(CHECKPOINT);
            checkpoint::write(&place, self.student.kind(), &contents)?;
        }
        self.metrics.flush()?;
        self.events.flush()
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
            updates = self.student.n_updates(),
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
fn metrics(training: &Training, student: &dyn Student) -> Result<Metrics> {
    let (columns, world_steps) = (student.columns(), student.world_steps());
    match (training.freeze, training.resume) {
        (true, _) => Metrics::begin(&training.out.join(FROZEN), columns),
        (false, true) => Metrics::go_on(&training.out.join(METRICS), columns, world_steps),
        (false, false) => Metrics::begin(&training.out.join(METRICS), columns),
    }
}

/// The file of TensorBoard's events: a run without learning has a folder of its own, and begins again.
fn events(training: &Training, student: &dyn Student) -> Result<Events> {
    match (training.freeze, training.resume) {
        (true, _) => Events::begin(&training.out.join(FROZEN_EVENTS), 0),
        (false, true) => Events::begin(&training.out, student.world_steps()),
        (false, false) => Events::begin(&training.out, 0),
    }
}
