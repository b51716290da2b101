//! What an estimator is: frames in, a belief about every cell out (paper sections III.A to III.C).

use crate::estimation::bayes::ZeroEvidence;
use crate::estimation::belief::{Belief, BeliefError};
use crate::estimation::follower::Follower;
use crate::estimation::parameters::Tables;
use crate::estimation::scoring::Score;
use ::network::NetworkError;
use protocol::{Frame, Grid};
use thiserror::Error;

/// Keeps a belief about one world: [`Self::correct`] with each frame, then [`Self::predict`].
pub trait Estimator: Send {
    /// Takes in a frame of X_k (eq. 5). `truth` is X_k, shape `[H, W]`, where somebody knows it: for oracles
    /// only.
    ///
    /// # Errors
    /// [`EstimatorError`] if the frame is impossible, or `truth` is needed and missing; the belief is then as
    /// it was.
    fn correct(&mut self, frame: &Frame, truth: Option<&Grid<u8>>) -> Result<(), EstimatorError>;

    /// Moves the belief from X_k to X_{k+1} (eq. 6).
    fn predict(&mut self);

    /// The belief: about X_k after [`Self::correct`], about X_{k+1} after [`Self::predict`].
    fn belief(&self) -> &Belief;

    /// Takes in the state X_{k+1} that the next path will meet, where somebody knows it.
    fn foresee(&mut self, _next: &Grid<u8>) -> Result<(), BeliefError> {
        Ok(())
    }

    /// Whether the belief is made of frames.
    fn sees_frames(&self) -> bool {
        true
    }

    /// Tells what [`Self::memory`] means, where that is all that the estimator remembers: another estimator of the
    /// same kind may go on from it.
    fn kind(&self) -> Option<String> {
        None
    }

    /// All that it remembers of its world before X_{k+1}: the belief, `[S, H, W]` as `f32`, then what its kind adds.
    fn memory(&self) -> Vec<u8> {
        self.belief().to_bytes()
    }

    /// Goes on from the memory of an estimator of its own [`Self::kind`]; returns whether it could. If not, it
    /// is as it was.
    fn remember(&mut self, _memory: &[u8]) -> bool {
        false
    }

    /// How well the belief predicts a frame; `None` of estimators that predict none.
    fn score(&self, _frame: &Frame) -> Result<Option<Score>, EstimatorError> {
        Ok(None)
    }

    /// Takes newer learned parameters of the same dimensions; the belief stays. Others ignore them.
    fn set_tables(&mut self, _tables: &Tables) {}

    /// The hidden vector behind the belief, for a DQN that decides on it (paper section III.E).
    fn follower(&self) -> Option<&Follower> {
        None
    }
}

/// Why an estimator did not take in what was seen.
#[derive(Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum EstimatorError {
    /// A frame that the belief rules out.
    #[error(transparent)]
    ZeroEvidence(#[from] ZeroEvidence),
    /// A network whose numbers are too large to be worked with, or whose device fails.
    #[error("checkpoint: {0}")]
    Network(#[from] NetworkError),
    #[error("hidden states: {0}")]
    Belief(#[from] BeliefError),
    /// An oracle that is not told the hidden states.
    #[error("the policy needs the truth channel: start the server with --publish-truth")]
    NoTruth,
}
