//! What to train on, and why that ended early.

use crate::config::{AgentConfig, LearnerKind};
use crate::estimation::parameters::DimensionsError;
use crate::learning::checkpoint::{self, CheckpointError, Contents};
use crate::learning::learner;
use crate::learning::metrics::MetricsError;
use crate::learning::student::{Student, StudentError, decisions, network};
use crate::learning::tensorboard::EventsError;
use ::network::{Device, NetworkError};
use protocol::connection::ConnectionError;
use protocol::model::ModelError;
use std::ops::Range;
use std::path::PathBuf;
use std::time::Duration;
use thiserror::Error;

/// The checkpoint's name in the folder of a training.
pub const CHECKPOINT: &str = "checkpoint.safetensors";

/// What to train on, for how long.
#[derive(Debug, Clone)]
pub struct Training {
    pub worlds: Range<u32>,
    /// Take the worlds from their holder.
    pub takeover: bool,
    /// World steps to act for, of all worlds together; 0: until stopped.
    pub steps: u64,
    /// Time to act for; `None`: until stopped.
    pub time_limit: Option<Duration>,
    pub out: PathBuf,
    /// Go on from the folder's checkpoint.
    pub resume: bool,
    /// Act on the parameters as they are.
    pub freeze: bool,
    pub device: Device,
    pub config: AgentConfig,
}

/// Why training ended early.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum TrainError {
    /// The server refused or is gone; what was learned is saved.
    #[error(transparent)]
    Connection(#[from] ConnectionError),
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    #[error(transparent)]
    Metrics(#[from] MetricsError),
    #[error(transparent)]
    Events(#[from] EventsError),
    /// Settings that no filter has with the server's observations.
    #[error(transparent)]
    Dimensions(#[from] DimensionsError),
    #[error("after {world_steps} world steps: {problem}; what was learned before is in {saved}")]
    Student {
        problem: Box<StudentError>,
        /// World steps that were learned from.
        world_steps: u64,
        saved: String,
    },
    /// What was learned could not be saved either.
    #[error("{problem}; what was learned is lost: {also}")]
    NotSaved {
        problem: Box<TrainError>,
        also: Box<TrainError>,
    },
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
    /// The networks, before their first step.
    #[error(transparent)]
    Network(#[from] NetworkError),
    /// The model that a filter needs.
    #[error(transparent)]
    Model(#[from] ModelError),
    #[error("learning decisions needs the server's model: start it with --reveal-model true")]
    NoModel,
    /// Settings that cannot be written into a checkpoint.
    #[error("settings: {0}")]
    Settings(#[from] toml::ser::Error),
}

impl Training {
    /// Checks folder and number of worlds, before a server is held or started for them; returns the
    /// contents of the checkpoint to go on from.
    pub fn check(&self) -> Result<Option<Contents>, TrainError> {
        let place = self.out.join(CHECKPOINT);
        if place.exists() && !self.resume {
            return Err(TrainError::Taken(self.out.display().to_string()));
        }
        let n_worlds = self.worlds.len();
        let kind = match self.config.learner {
            LearnerKind::Filter => learner::KIND,
            LearnerKind::Autoencoder if n_worlds != 1 => {
                return Err(TrainError::OneWorld(n_worlds));
            }
            LearnerKind::Autoencoder => network::KIND,
            LearnerKind::Decisions => decisions::KIND,
        };
        if !self.resume {
            return Ok(None);
        }
        let (_, contents) = checkpoint::read(&place, &[kind])?;
        if toml::to_string(&self.config)? != contents.settings {
            tracing::warn!(
                "settings: other than the checkpoint was trained with; these hold from here on"
            );
        }
        Ok(Some(contents))
    }

    /// The error for a student that cannot go on; what it learned is saved when training ends.
    pub(super) fn stopped(&self, problem: StudentError, student: &dyn Student) -> TrainError {
        if let StudentError::Connection(problem) = problem {
            return problem.into();
        }
        TrainError::Student {
            problem: problem.into(),
            world_steps: student.world_steps(),
            saved: self.out.join(CHECKPOINT).display().to_string(),
        }
    }
}
