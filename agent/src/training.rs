//! Trains a learner while it acts: a loop of steps of all robots, updates, and checkpoints at intervals.
//!
//! The learner receives the grid, the number of observation values, and each path's reward and frame. A model that the
//! server reveals is read only for decisions on a known-model belief. One request moves all robots by one step. The
//! [`Learner`] determines what is learned, and how to act in the meantime.

pub mod metrics;
pub mod seconds;
mod shown_learner;
mod spec;

pub use self::spec::{CHECKPOINT, TrainingSpec};

use self::shown_learner::ShownLearner;
use crate::client::info::{warn_of_other_worlds, world_names};
use crate::client::worlds::Worlds;
use crate::training::metrics::{METRICS, Metrics, Tick};
use crate::training::seconds::Stopwatch;
use anyhow::{Context, Result, bail, ensure};
use emberwatch_acting::rollout;
use emberwatch_acting::served::Served;
use emberwatch_belief::estimation::scoring::Score;
use emberwatch_learning::checkpoint::{self, Contents};
use emberwatch_learning::learners::{self, Learner, LearnerInputs, LearnerKind, ModelUpdate};
use emberwatch_protocol::client::{Backend, Claim, Client, Observation};
use emberwatch_protocol::connection::ConnectionError;
use emberwatch_protocol::control::WorldSeed;
use emberwatch_protocol::feed::Feed;
use std::fs::{File, TryLockError};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

const SAVE_INTERVAL: Duration = Duration::from_secs(30);

const REPORT_INTERVAL: Duration = Duration::from_secs(5);

/// Time to live of the lease: longer than pauses for a slow disk or the simulation of a prior.
const LEASE: Duration = Duration::from_secs(600);

#[derive(Debug, Clone, Default, PartialEq)]
pub struct TrainSummary {
    /// World steps, summed over all worlds.
    pub steps: u64,
    /// Number of updates, including earlier runs that this run resumes.
    pub updates: u64,
    pub reward: f64,
}

/// Trains until the steps are done or `stop` is set, then saves. `contents`: of [`TrainingSpec::check`].
pub fn train(
    worlds: &mut Worlds,
    spec: &TrainingSpec,
    contents: Option<Contents>,
    stop: &AtomicBool,
) -> Result<TrainSummary> {
    let mut training_loop = TrainingLoop::attach(worlds, spec, contents)?;
    let outcome = training_loop.act(spec, stop);
    let saved = training_loop.save(spec);
    match (outcome, saved) {
        (Ok(()), saved) => saved?,
        (Err(problem), Ok(())) => return Err(problem),
        (Err(problem), Err(also)) => {
            bail!("{problem:#}; the training since the last checkpoint is lost: {also:#}");
        }
    }
    training_loop.warn_of_no_update();
    training_loop.client.release()?;
    training_loop.feed.end();
    Ok(training_loop.summary)
}

struct TrainingLoop<'a> {
    client: Client<&'a mut Worlds>,
    kind: &'static LearnerKind,
    learner: Box<dyn Learner>,
    metrics: Metrics,
    stopwatch: Stopwatch,
    feed: Feed,
    summary: TrainSummary,
    n_before: u64,
    saved: Instant,
    reported: Reported,
    _lock: File,
}

struct Reported {
    at: Instant,
    steps: u64,
    reward: f64,
    score: Score,
}

impl<'a> TrainingLoop<'a> {
    fn attach(
        worlds: &'a mut Worlds,
        spec: &TrainingSpec,
        contents: Option<Contents>,
    ) -> Result<Self> {
        let lock = lock(&spec.out)?;
        let stopwatch = Stopwatch::start(&spec.out, spec.resume)?;
        if let Some(contents) = &contents
            && contents.settings().map_or(true, |it| it != spec.config)
        {
            tracing::warn!("the settings differ from the checkpoint's, and replace them");
        }
        let claim = Claim {
            robots: spec.robots(worlds.info())?,
            takeover: spec.takeover,
            time_to_live: Some(LEASE),
        };
        let mut client = Client::acquire(worlds, &claim)?;
        let kind = spec.learner()?;
        let mut learner = new_learner(spec, kind, &client, contents.as_ref())?;
        let metrics = metrics(spec, kind, &*learner)?;
        let observations = first_observations(&mut client, spec)?;
        let seed = observations[0].world.seed;
        if spec.resume {
            let world_steps = learner.world_steps();
            tracing::info!(
                seed,
                world_steps,
                "resumed in new worlds, with an empty replay buffer"
            );
        } else {
            tracing::info!(seed, "the first world");
        }
        for (robot, observation) in client.robots().zip(observations) {
            let begun = learner.start_episode(robot, observation);
            begun.map_err(|problem| spec.stopped(problem, &*learner))?;
        }
        let belief = learner.agent(0).agent.belief();
        let feed = client.backend().feed(belief.probabilities());
        let now = Instant::now();
        Ok(Self {
            client,
            kind,
            n_before: learner.n_updates(),
            learner,
            metrics,
            stopwatch,
            feed,
            summary: TrainSummary::default(),
            saved: now,
            reported: Reported::at(now, &TrainSummary::default()),
            _lock: lock,
        })
    }

    fn act(&mut self, spec: &TrainingSpec, stop: &AtomicBool) -> Result<()> {
        let is_done = |steps: u64| spec.steps > 0 && steps >= spec.steps;
        while !is_done(self.summary.steps) && !stop.load(Ordering::Relaxed) {
            let tick = self.step();
            let tick = tick.map_err(|problem| spec.stopped(problem, &*self.learner))?;
            let updates = self.learner.learn();
            let mut updates = updates.map_err(|problem| spec.stopped(problem, &*self.learner))?;
            self.summary.updates = self.learner.n_updates();
            if updates.is_empty() {
                let n_more = self.kind.columns.len();
                updates.push(ModelUpdate::nothing(self.summary.updates, n_more));
            }
            self.metrics.add(&tick, &updates)?;
            self.report(&tick, spec.steps);
            if self.saved.elapsed() > SAVE_INTERVAL {
                self.save(spec)?;
            }
        }
        Ok(())
    }

    fn step(&mut self) -> Result<Tick> {
        let shows_all = self.learner.wants_full_frames();
        let learner = &mut *self.learner;
        let mut shown = ShownLearner::new(learner, self.kind, &mut self.feed, &self.client);
        let mut served = Served::new(&mut self.client, shows_all);
        let records = rollout::step(&mut shown, &mut served)?.unwrap_or_default();
        let tick = Tick::of(&records, self.learner.world_steps());
        let robots = self.client.robots();
        let present = (0..robots.len()).map(|index| self.learner.agent(index).observation());
        let over = ended(&self.client, present);
        for (robot, observation) in reset(&mut self.client, &over)? {
            self.learner.start_episode(robot, observation)?;
        }
        self.summary.steps += tick.n_worlds;
        self.summary.reward += tick.reward;
        Ok(tick)
    }

    fn save(&mut self, spec: &TrainingSpec) -> Result<()> {
        self.saved = Instant::now();
        let contents = self.learner.contents();
        let mut contents = contents.map_err(|error| spec.stopped(error, &*self.learner))?;
        contents.settings = toml::to_string(&spec.config)?;
        contents.worlds = world_names(self.client.info());
        let place = spec.out.join(CHECKPOINT);
        checkpoint::write(&place, self.kind.checkpoint, &contents)?;
        self.stopwatch.write()?;
        self.metrics.flush()
    }

    fn warn_of_no_update(&self) {
        let steps = self.summary.steps;
        if steps > 0 && self.learner.n_updates() == self.n_before {
            tracing::warn!(
                "nothing was learned in {steps} world steps: train for more --steps, on longer episodes, or with \
                 smaller settings of the learner (batch, window, streams)"
            );
        }
    }

    fn report(&mut self, tick: &Tick, all_steps: u64) {
        let last = &mut self.reported;
        last.score += tick.score;
        if last.at.elapsed() < REPORT_INTERVAL {
            return;
        }
        let steps = self.summary.steps - last.steps;
        let before = tick.world_steps - self.summary.steps;
        let of = (all_steps > 0).then_some(before + all_steps);
        tracing::info!(
            world_steps = tick.world_steps,
            of = of,
            updates = self.learner.n_updates(),
            log_likelihood = last.score.mean(),
            mean_reward = (self.summary.reward - last.reward) / steps.max(1) as f64,
            "training"
        );
        *last = Reported::at(Instant::now(), &self.summary);
    }
}

impl Reported {
    fn at(at: Instant, summary: &TrainSummary) -> Self {
        Self {
            at,
            steps: summary.steps,
            reward: summary.reward,
            score: Score::default(),
        }
    }
}

fn new_learner(
    spec: &TrainingSpec,
    kind: &LearnerKind,
    client: &Client<impl Backend>,
    contents: Option<&Contents>,
) -> Result<Box<dyn Learner>> {
    let info = client.info();
    let mut learned = spec.learned.clone();
    learned.worlds.extend(contents.map(|it| it.worlds.clone()));
    warn_of_other_worlds(&learned, info);
    let worlds = learners::Worlds {
        airspace: info.airspace().map_err(anyhow::Error::msg)?,
        n_observations: info.n_observations,
        n_moves: info.n_moves,
        numbers: client.robots(),
    };
    let learner = (kind.build)(LearnerInputs {
        worlds,
        info,
        config: &spec.config,
        contents,
        learned: &spec.learned,
        device: &spec.device,
    });
    match contents {
        None => learner,
        Some(_) => {
            let place = spec.out.join(CHECKPOINT);
            learner.with_context(|| format!("resume {}", place.display()))
        }
    }
}

fn lock(folder: &Path) -> Result<File> {
    let file = File::open(folder).with_context(|| format!("--out {}", folder.display()))?;
    // File systems without locks are used without one.
    let is_free = !matches!(file.try_lock(), Err(TryLockError::WouldBlock));
    ensure!(
        is_free,
        "--out {}: expected a folder in which no training runs, got one with a running training",
        folder.display()
    );
    Ok(file)
}

/// Returns the first observations of the client's robots. Worlds start the episodes of the training's seeds, if it has
/// any. Otherwise, their episodes continue, or the next begin where one has ended.
fn first_observations(
    client: &mut Client<impl Backend>,
    spec: &TrainingSpec,
) -> Result<Vec<Observation>, ConnectionError> {
    if let Some(first) = spec.first_seed {
        let worlds = spec
            .worlds
            .clone()
            .zip(0..)
            .map(|(world, index)| WorldSeed {
                world,
                seed: Some(first.wrapping_add(index)),
            });
        client.reset(&worlds.collect::<Vec<_>>())?;
    }
    let mut observations = client.observe(client.robots())?;
    let over = ended(client, observations.iter());
    for (robot, seen) in reset(client, &over)? {
        observations[(robot - client.robots().start) as usize] = seen;
    }
    Ok(observations)
}

fn is_over(seen: &Observation) -> bool {
    seen.world.truncated != 0 || seen.world.terminated != 0
}

fn ended<'a>(
    client: &Client<impl Backend>,
    observations: impl Iterator<Item = &'a Observation>,
) -> Vec<u32> {
    let robots = client.robots().zip(observations);
    let over = robots.filter(|(_, seen)| is_over(seen));
    let mut worlds: Vec<u32> = over
        .map(|(robot, _)| robot / client.info().n_robots)
        .collect();
    worlds.dedup();
    worlds
}

fn reset(
    client: &mut Client<impl Backend>,
    worlds: &[u32],
) -> Result<Vec<(u32, Observation)>, ConnectionError> {
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

fn metrics(spec: &TrainingSpec, kind: &LearnerKind, learner: &dyn Learner) -> Result<Metrics> {
    let (columns, world_steps) = (kind.columns, learner.world_steps());
    let path = spec.out.join(METRICS);
    if spec.resume {
        Metrics::reopen(&path, columns, world_steps)
    } else {
        Metrics::create(&path, columns)
    }
}
