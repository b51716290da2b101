//! What may be wrong with a checkpoint.

use crate::estimation::belief::BeliefError;
use std::path::{Path, PathBuf};
use thiserror::Error;

/// Largest file that is written or read, bytes: 200 times what a full replay of 64 x 64 cells and 3
/// states needs.
pub const MAX_BYTES: u64 = 1 << 32;

/// Why a checkpoint could not be written or was refused.
#[derive(Debug, Error)]
#[error("checkpoint {}: {problem}", path.display())]
pub struct CheckpointError {
    path: PathBuf,
    problem: Problem,
}

/// What is wrong with a checkpoint.
#[derive(Debug, Error)]
pub enum Problem {
    /// The system refused.
    #[error("{0}")]
    Io(#[from] std::io::Error),
    /// A folder, a pipe or a device, which may never end.
    #[error("expected a regular file, got something else")]
    NoFile,
    /// Too large to be one.
    #[error("expected at most {MAX_BYTES} bytes, got {0}")]
    Large(u64),
    /// Not safetensors, or cut off.
    #[error("expected a whole safetensors file, got one that is damaged or cut off: {0}")]
    Form(String),
    /// The networks in it.
    #[error(transparent)]
    Network(#[from] ::network::NetworkError),
    /// The second of its kind.
    #[error("expected one checkpoint of {0}, got two")]
    Twice(&'static str),
    /// Another learner's, or none's.
    #[error("expected a checkpoint of {expected}, got one of {got}")]
    Kind {
        /// Whose was asked for.
        expected: String,
        /// Whose it is.
        got: String,
    },
    /// The form is right and the numbers are not those that were written.
    #[error("expected contents with digest {expected}, got {got}: the file is damaged")]
    Digest {
        /// What the file says.
        expected: String,
        /// What its contents give.
        got: String,
    },
    /// A tensor or text that is missing.
    #[error("expected {0:?} in it, found none")]
    Missing(String),
    /// A tensor of another shape.
    #[error("{name}: expected shape {expected:?}, got {got:?}")]
    Shape {
        /// The tensor.
        name: String,
        /// What it must be.
        expected: Vec<usize>,
        /// What it is.
        got: Vec<usize>,
    },
    /// A predictor that is no belief.
    #[error("state.prediction: {0}")]
    Prediction(#[from] BeliefError),
    /// A tensor or text with something else in it.
    #[error("{name}: expected {expected}, got {got}")]
    Value {
        /// The tensor or text.
        name: String,
        /// What it must be.
        expected: String,
        /// What it is.
        got: String,
    },
}

impl Problem {
    /// The error for a file.
    pub fn of(self, path: &Path) -> CheckpointError {
        let path = path.to_owned();
        let problem = self;
        CheckpointError { path, problem }
    }
}
