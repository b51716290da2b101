//! Learns a model while acting: attach, fly, correct, learn, predict, on several worlds at once.
//!
//! The learner is told the grid, the number of observations and each path's reward and frame; the
//! model that a server may reveal is not read. One message steps all worlds, so that what is
//! learned from in a step comes from worlds that differ. Rewards say which learned state pays
//! ([`crate::reward`]).

use crate::checkpoint::{self, CheckpointError, Problem};
use crate::client::{Claim, Client};
use crate::config::{AgentConfig, ConfigError};
use crate::estimator::ZeroEvidence;
use crate::estimator::learned_filter::{Dimensions, DimensionsError, NotFinite, Update};
use crate::learner::{KIND, Learned, Learner, Progress};
use crate::metrics::{Metrics, MetricsError, Tick};
use crate::pilot::{Pilot, Stand};
use crate::policy::PlannerKind;
use crate::scoring::Score;
use protocol::Move;
use protocol::channels::Instance;
use protocol::connection::ConnectionError;
use protocol::control::WorldSeed;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use thiserror::Error;

/// The checkpoint's name in the folder of a training.
pub const CHECKPOINT: &str = "checkpoint.safetensors";

/// How often a checkpoint is written while training goes on.
const SAVE_INTERVAL: Duration = Duration::from_secs(30);

/// How often progress is told.
const REPORT_INTERVAL: Duration = Duration::from_secs(5);

/// The lease outlives a pause of this length, such as a slow disk's.
const LEASE: Duration = Duration::from_secs(60);

/// What to train on, for how long.
#[derive(Debug, Clone)]
pub struct Training {
    /// The server.
    pub instance: Instance,
    /// The worlds to act on.
    pub worlds: Range<u32>,
    /// Take the worlds from their holder.
    pub takeover: bool,
    /// World steps to act for, of all worlds together; 0: until stopped.
    pub steps: u64,
    /// Time to act for; `None`: until stopped.
    pub time_limit: Option<Duration>,
    /// Folder of checkpoint and metrics.
    pub out: PathBuf,
    /// Go on from the folder's checkpoint.
    pub resume: bool,
    /// Act on the parameters as they are.
    pub freeze: bool,
    /// Settings.
    pub config: AgentConfig,
}

/// Why training ended early.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum TrainError {
    /// The server refused or is gone; what was learned is saved.
    #[error(transparent)]
    Connection(#[from] ConnectionError),
    /// The checkpoint.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The metrics.
    #[error(transparent)]
    Metrics(#[from] MetricsError),
    /// The settings.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// Settings that no filter has with the server's observations.
    #[error(transparent)]
    Dimensions(#[from] DimensionsError),
    /// A frame that the belief held for impossible.
    #[error(transparent)]
    ZeroEvidence(#[from] ZeroEvidence),
    /// A folder that holds a training already.
    #[error("--out {0}: expected --resume or a folder without a checkpoint, got one with it")]
    Taken(String),
    /// Settings that cannot be written into a checkpoint.
    #[error("settings: {0}")]
    Settings(#[from] toml::ser::Error),
    /// A number that is not finite.
    #[error("{problem}; the parameters before it are in {saved}")]
    NotFinite {
        /// Where it is.
        problem: NotFinite,
        /// The checkpoint.
        saved: String,
    },
}

/// What a training did.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct TrainSummary {
    /// World steps acted, of all worlds together.
    pub steps: u64,
    /// Updates made, with those before a resume.
    pub updates: u64,
    /// Sum of rewards.
    pub reward: f64,
    /// Time in updates.
    pub learning: Duration,
}

/// Trains until the steps are done, the time is over or `stop` is set; saves in any case.
///
/// # Errors
/// [`TrainError`].
pub fn train(training: &Training, stop: &AtomicBool) -> Result<TrainSummary, TrainError> {
    let mut trainee = Trainee::attach(training)?;
    let deadline = training.time_limit.map(|limit| Instant::now() + limit);
    let outcome = trainee.act(training, stop, deadline);
    let saved = trainee.save(training);
    outcome?;
    saved?;
    trainee.client.release()?;
    Ok(trainee.summary)
}

/// A learner at its worlds.
struct Trainee {
    client: Client,
    pilots: Vec<Pilot>,
    learner: Learner,
    metrics: Metrics,
    summary: TrainSummary,
    saved: Instant,
    told: (Instant, TrainSummary, Score),
}

impl Trainee {
    fn attach(training: &Training) -> Result<Self, TrainError> {
        let place = training.out.join(CHECKPOINT);
        if place.exists() && !training.resume {
            return Err(TrainError::Taken(training.out.display().to_string()));
        }
        // A checkpoint that cannot be read is refused before worlds are held for it.
        let contents = match training.resume {
            true => Some(checkpoint::read(&place, KIND)?),
            false => None,
        };
        let claim = Claim {
            worlds: training.worlds.clone(),
            takeover: training.takeover,
            time_to_live: Some(LEASE),
        };
        let mut client = Client::acquire(&training.instance, &claim)?;
        let dimensions = dimensions(&training.config, client.info().n_observations)?;
        let config = &training.config;
        let shape = client.shape();
        let wrong = |problem: Problem| problem.of(&place);
        let mut learner = match &contents {
            Some(contents) => {
                Learner::from_contents(contents, dimensions, shape, config).map_err(wrong)?
            }
            None => Learner::new(Progress::first(dimensions, config.seed), shape, config),
        };
        let stands = match &contents {
            Some(contents) => {
                Stand::restored(dimensions.n_states, shape, contents).map_err(wrong)?
            }
            None => BTreeMap::new(),
        };
        let metrics = Metrics::open(&training.out, training.resume)?;
        let learned = learner.learned();
        let observations = client.observe(client.worlds())?;
        if training.resume && !Stand::any_is_of(&stands, client.worlds(), &observations) {
            tracing::info!("other worlds than the checkpoint's: an empty replay");
            learner.forget();
        }
        let mut pilots = Vec::new();
        for (world, observation) in client.worlds().zip(observations) {
            let mut pilot = Pilot::new(&learned, shape, observation, config);
            let goes_on = pilot.go_on(world, stands.get(&world), &mut learner)?;
            if training.resume && !goes_on {
                tracing::info!(world, "a new track");
            }
            pilots.push(pilot);
        }
        let now = Instant::now();
        Ok(Self {
            client,
            pilots,
            learner,
            metrics,
            summary: TrainSummary::default(),
            saved: now,
            told: (now, TrainSummary::default(), Score::default()),
        })
    }

    fn act(
        &mut self,
        training: &Training,
        stop: &AtomicBool,
        deadline: Option<Instant>,
    ) -> Result<(), TrainError> {
        let is_over = || deadline.is_some_and(|deadline| Instant::now() >= deadline);
        let is_done = |steps: u64| training.steps > 0 && steps >= training.steps;
        while !is_done(self.summary.steps) && !stop.load(Ordering::Relaxed) && !is_over() {
            let tick = self.step(training)?;
            let updates = match training.freeze {
                true => {
                    self.learner.rest();
                    Vec::new()
                }
                false => self.learn(training)?,
            };
            self.metrics
                .add(&tick, &updates, self.learner.n_updates())?;
            self.report(&tick);
            if self.saved.elapsed() > SAVE_INTERVAL {
                self.save(training)?;
                self.metrics.flush()?;
            }
        }
        Ok(())
    }

    /// Plans, flies, scores, corrects, predicts: one step of each world.
    fn step(&mut self, training: &Training) -> Result<Tick, TrainError> {
        let learned = self.learner.learned();
        let n_moves = self.client.info().n_moves;
        let n_walking = self.n_walking(training);
        let plan = |(index, pilot): (usize, &mut Pilot)| {
            pilot.filter.set(&learned.tables);
            let kind = match index < n_walking {
                true => PlannerKind::RandomWalk,
                false => PlannerKind::Beam,
            };
            pilot.plan(kind, learned.target, &training.config, n_moves)
        };
        let pilots = self.pilots.par_iter_mut().enumerate();
        let paths: Vec<Vec<Move>> = pilots.map(plan).collect();
        let observations = self.client.step(self.client.worlds(), &paths)?;
        let mut tick = Tick::default();
        let worlds = self.client.worlds().zip(observations).zip(&mut self.pilots);
        for ((world, observation), pilot) in worlds {
            tick.reward += observation.result.reward;
            tick.score += pilot.take_in(world, observation, &mut self.learner)?;
        }
        self.pilots
            .par_iter_mut()
            .for_each(|pilot| pilot.filter.predict());
        self.reset_ended(&learned, training)?;
        tick.n_worlds = self.pilots.len() as u64;
        tick.world_steps = self.learner.world_steps();
        self.summary.steps += tick.n_worlds;
        self.summary.reward += tick.reward;
        Ok(tick)
    }

    /// Worlds whose robots walk at random: all at first, some for good.
    fn n_walking(&self, training: &Training) -> usize {
        let learning = &training.config.learning;
        let n_worlds = self.pilots.len();
        if self.learner.world_steps() < learning.explore_steps {
            return n_worlds;
        }
        (learning.explore_share * n_worlds as f64).round() as usize
    }

    fn learn(&mut self, training: &Training) -> Result<Vec<Update>, TrainError> {
        let start = Instant::now();
        let updates = self.learner.learn();
        self.summary.learning += start.elapsed();
        self.summary.updates = self.learner.n_updates();
        match updates {
            Ok(updates) => Ok(updates),
            Err(problem) => {
                let saved = self.save(training)?;
                self.metrics.flush()?;
                let saved = saved.display().to_string();
                Err(TrainError::NotFinite { problem, saved })
            }
        }
    }

    /// Starts episodes anew that reached their end.
    fn reset_ended(&mut self, learned: &Learned, training: &Training) -> Result<(), TrainError> {
        for (world, pilot) in self.client.worlds().zip(&mut self.pilots) {
            let result = &pilot.observation.result;
            if result.truncated == 0 && result.terminated == 0 {
                continue;
            }
            self.client.reset(&[WorldSeed { world, seed: None }])?;
            let observation = self.client.observe(world..world + 1)?.remove(0);
            *pilot = Pilot::new(learned, self.client.shape(), observation, &training.config);
            pilot.begin(world, &mut self.learner)?;
        }
        Ok(())
    }

    fn save(&mut self, training: &Training) -> Result<PathBuf, TrainError> {
        self.saved = Instant::now();
        let place = training.out.join(CHECKPOINT);
        let settings = toml::to_string(&training.config)?;
        let mut contents = self.learner.to_contents(&settings);
        let pilots = self.client.worlds().zip(&self.pilots);
        Stand::store(pilots, self.client.shape(), &mut contents);
        checkpoint::write(&place, KIND, &contents)?;
        Ok(place)
    }

    fn report(&mut self, tick: &Tick) {
        let (since, before, score) = &mut self.told;
        *score += tick.score;
        if since.elapsed() < REPORT_INTERVAL {
            return;
        }
        let steps = self.summary.steps - before.steps;
        tracing::info!(
            world_steps = tick.world_steps,
            updates = self.learner.n_updates(),
            log_likelihood = score.mean(),
            mean_reward = (self.summary.reward - before.reward) / steps.max(1) as f64,
            "training"
        );
        self.told = (Instant::now(), self.summary, Score::default());
    }
}

/// What was learned by a checkpoint.
///
/// # Errors
/// [`CheckpointError`].
pub fn read_learned(path: &Path) -> Result<Learned, CheckpointError> {
    let contents = checkpoint::read(path, KIND)?;
    let progress = Progress::from_contents(&contents, None);
    Ok(progress.map_err(|problem| problem.of(path))?.learned())
}

fn dimensions(config: &AgentConfig, n_observations: usize) -> Result<Dimensions, DimensionsError> {
    let learning = config.learning;
    let n_states = match learning.states {
        0 => n_observations,
        states => states,
    };
    let kernel = (learning.kernel[0], learning.kernel[1]);
    let dimensions = Dimensions {
        n_states,
        n_observations,
        kernel,
    };
    dimensions.check()
}
