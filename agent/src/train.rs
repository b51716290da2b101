//! Learns while acting: attach, fly, correct, learn, predict, save.
//!
//! The learner is told the grid, the number of observations and each path's reward and frame; the
//! model that a server may reveal is not read, but by who learns decisions. One message steps all worlds. What is learned, and how
//! it acts meanwhile, is a [`Student`]'s.

use crate::checkpoint::{self, CheckpointError, Contents, Problem};
use crate::client::{Claim, Client};
use crate::config::{AgentConfig, ConfigError, LearnerKind};
use crate::estimator::learned_filter::{Dimensions, DimensionsError};
use crate::estimator::{Filter, ZeroEvidence};
use crate::learner;
use crate::metrics::{Metrics, MetricsError, Tick};
use crate::scoring::Score;
use crate::student::decisions::{self, Decisions, DecisionsStudent};
use crate::student::filter::FilterStudent;
use crate::student::network::{self, NetworkStudent};
use crate::student::{Lesson, NotFinite, Site, Student};
use protocol::Model;
use protocol::channels::Instance;
use protocol::connection::ConnectionError;
use protocol::control::{CoverageRule, WorldSeed};
use protocol::model::ModelError;
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

/// The lease outlives a pause of this length, such as a slow disk's or that in which a prior is simulated.
const LEASE: Duration = Duration::from_secs(600);

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
    /// Full frames that the server does not give.
    #[error(
        "autoencoder.full_frames: {0} frames that show every cell need a server with --coverage \
         client or full, or the setting 0"
    )]
    NoFullFrames(u64),
    /// Worlds that one memory cannot follow.
    #[error("--worlds: expected 1 for the autoencoder, which follows one world, got {0}")]
    OneWorld(usize),
    /// The model that a filter needs.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A server that hides it.
    #[error("learning decisions needs the server's model: start it with --reveal-model true")]
    NoModel,
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
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TrainSummary {
    /// World steps acted, of all worlds together.
    pub steps: u64,
    /// Updates made, with those before a resume.
    pub updates: u64,
    /// Sum of rewards.
    pub reward: f64,
    /// Time spent, by part.
    pub times: Vec<(&'static str, Duration)>,
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
    student: Box<dyn Student>,
    metrics: Metrics,
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

impl Trainee {
    fn attach(training: &Training) -> Result<Self, TrainError> {
        let place = training.out.join(CHECKPOINT);
        if place.exists() && !training.resume {
            return Err(TrainError::Taken(training.out.display().to_string()));
        }
        // A checkpoint that cannot be read is refused before worlds are held for it.
        let kind = match training.config.learner {
            LearnerKind::Filter => learner::KIND,
            LearnerKind::Autoencoder => network::KIND,
            LearnerKind::Decisions => decisions::KIND,
        };
        let contents = match training.resume {
            true => Some(checkpoint::read(&place, kind)?),
            false => None,
        };
        let claim = Claim {
            worlds: training.worlds.clone(),
            takeover: training.takeover,
            time_to_live: Some(LEASE),
        };
        let mut client = Client::acquire(&training.instance, &claim)?;
        let mut student = student(training, &client, contents.as_ref(), &place)?;
        let metrics = Metrics::open(&training.out, student.columns(), training.resume)?;
        let observations = client.observe(client.worlds())?;
        if !student.attach(observations)? && training.resume {
            tracing::info!("other worlds than the checkpoint's, or other steps: beginning anew");
        }
        let now = Instant::now();
        Ok(Self {
            client,
            student,
            metrics,
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
    ) -> Result<(), TrainError> {
        let is_over = || deadline.is_some_and(|deadline| Instant::now() >= deadline);
        let is_done = |steps: u64| training.steps > 0 && steps >= training.steps;
        while !is_done(self.summary.steps) && !stop.load(Ordering::Relaxed) && !is_over() {
            let tick = self.step()?;
            let lessons = match training.freeze {
                true => {
                    self.student.rest();
                    Vec::new()
                }
                false => self.learn(training)?,
            };
            let n_updates = self.student.n_updates();
            self.metrics.add(&tick, &lessons, n_updates)?;
            self.report(&tick);
            if self.saved.elapsed() > SAVE_INTERVAL {
                self.save(training)?;
                self.metrics.flush()?;
            }
        }
        Ok(())
    }

    /// Plans, flies, scores, corrects, predicts: one step of each world.
    fn step(&mut self) -> Result<Tick, TrainError> {
        let paths = self.student.plan();
        let worlds = self.client.worlds();
        let observations = match self.student.wants_full_frames() {
            true => self.client.step_full(worlds.clone(), &paths)?,
            false => self.client.step(worlds.clone(), &paths)?,
        };
        let ended = worlds.zip(&observations).filter(|(_, seen)| {
            let result = &seen.result;
            result.truncated != 0 || result.terminated != 0
        });
        let ended: Vec<u32> = ended.map(|(world, _)| world).collect();
        let tick = self.student.take_in(observations)?;
        for world in ended {
            self.client.reset(&[WorldSeed { world, seed: None }])?;
            let observation = self.client.observe(world..world + 1)?.remove(0);
            self.student.begin(world, observation)?;
        }
        self.summary.steps += tick.n_worlds;
        self.summary.reward += tick.reward;
        Ok(tick)
    }

    fn learn(&mut self, training: &Training) -> Result<Vec<Lesson>, TrainError> {
        let lessons = self.student.learn();
        self.summary.updates = self.student.n_updates();
        lessons.or_else(|problem| {
            let saved = self.save(training)?.display().to_string();
            self.metrics.flush()?;
            Err(TrainError::NotFinite { problem, saved })
        })
    }

    fn save(&mut self, training: &Training) -> Result<PathBuf, TrainError> {
        self.saved = Instant::now();
        let place = training.out.join(CHECKPOINT);
        let mut contents = self.student.contents();
        let settings = toml::to_string(&training.config)?;
        contents.texts.insert("settings".into(), settings);
        checkpoint::write(&place, self.student.kind(), &contents)?;
        self.summary.times = self.student.times();
        Ok(place)
    }

    fn report(&mut self, tick: &Tick) {
        let told = &mut self.told;
        told.score += tick.score;
        if told.at.elapsed() < REPORT_INTERVAL {
            return;
        }
        let steps = self.summary.steps - told.steps;
        tracing::info!(
            world_steps = tick.world_steps,
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

/// What the settings say that learns, going on from a checkpoint's contents if there are any.
fn student(
    training: &Training,
    client: &Client,
    contents: Option<&Contents>,
    place: &Path,
) -> Result<Box<dyn Student>, TrainError> {
    let (info, config) = (client.info(), &training.config);
    let site = Site {
        shape: client.shape(),
        n_observations: info.n_observations,
        n_moves: info.n_moves,
        worlds: training.worlds.clone(),
    };
    let wrong = |problem: Problem| problem.of(place);
    Ok(match config.learner {
        LearnerKind::Filter => {
            let dimensions = dimensions(config, site.n_observations)?;
            Box::new(match contents {
                Some(contents) => {
                    FilterStudent::resume(contents, dimensions, site, config).map_err(wrong)?
                }
                None => FilterStudent::new(dimensions, site, config),
            })
        }
        LearnerKind::Autoencoder => {
            if site.worlds.len() != 1 {
                return Err(TrainError::OneWorld(site.worlds.len()));
            }
            let mut progress = network::Progress::first(&site, config);
            if let Some(contents) = contents {
                progress.load(contents).map_err(wrong)?;
            }
            let full_frames = config.autoencoder.full_frames;
            if progress.iterations < full_frames && info.coverage == CoverageRule::Path {
                return Err(TrainError::NoFullFrames(full_frames));
            }
            Box::new(NetworkStudent::new(progress, site, config))
        }
        LearnerKind::Decisions => {
            let model = info.model.as_deref().ok_or(TrainError::NoModel)?;
            let model = Model::from_toml(model)?;
            let mut decisions = Decisions::first(&model, &config.decisions, config.seed);
            if let Some(contents) = contents {
                decisions.load(contents).map_err(wrong)?;
            }
            let prior = config.prior(info.burn_in);
            let filter = Filter::new(&model, prior.belief(&model, site.shape, config.seed)?)?;
            Box::new(DecisionsStudent::new(
                decisions, filter, &model, site, config,
            ))
        }
    })
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
