//! What an estimator is: frames in, a belief about every cell out (paper sections III.A to III.C).

use crate::estimation::bayes::ZeroEvidence;
use crate::estimation::belief::{Belief, BeliefError};
use emberwatch_model::grid::Probabilities;
use emberwatch_model::{Frame, Grid};
use ndarray::Array2;
use std::any::Any;
use std::borrow::Cow;
use std::error::Error as StdError;
use thiserror::Error;

/// Keeps a belief about one world: [`Self::correct`] with each frame, then [`Self::predict`].
///
/// That is all that an estimator must do. What only some have, they offer beside it.
pub trait Estimator: Send + Any {
    /// Takes in a frame of X_k (eq. 5).
    ///
    /// # Errors
    /// If the frame is impossible under the belief, which is then as it was.
    fn correct(&mut self, frame: &Frame) -> Result<(), EstimatorError>;

    /// Moves the belief from X_k to X_{k+1} (eq. 6).
    fn predict(&mut self);

    /// Returns a function that predicts several estimators, of any kind, with the same results as [`Self::predict`] on
    /// each. Estimators that predict many worlds faster together provide it.
    fn predict_together(&self) -> Option<fn(Vec<&mut dyn Estimator>)> {
        None
    }

    /// The belief: about X_k after [`Self::correct`], about X_{k+1} after [`Self::predict`].
    fn belief(&self) -> &Belief;

    /// Returns about how many bytes of memory the estimator takes: by default four times its belief, for the belief, its
    /// predictor and work space.
    fn memory_bytes(&self) -> usize {
        4 * size_of_val(self.belief().as_slice())
    }

    /// `P(y | x)`, shape `[S, O]`, of an estimator whose belief predicts frames.
    fn likelihood(&self) -> Option<Cow<'_, Array2<f64>>> {
        None
    }

    /// Of one that corrects a filter: what that filter predicts the next frame to show in each cell, `[O, H, W]`.
    fn base(&self) -> Option<&Probabilities> {
        None
    }

    /// The hidden vector `h_k` behind the belief, for a DQN that decides on it (paper section III.E).
    fn hidden(&self) -> Option<&[f32]> {
        None
    }

    /// An estimator from whose bytes another of its kind can go on.
    fn handover(&self) -> Option<&dyn Handover> {
        None
    }

    /// As [`Self::handover`], to go on from bytes.
    fn handover_mut(&mut self) -> Option<&mut dyn Handover> {
        None
    }

    /// An oracle, which must be told the hidden states.
    fn told(&mut self) -> Option<&mut dyn Told> {
        None
    }
}

/// All that an estimator knows of its world before X_{k+1}, as bytes.
pub trait Handover {
    /// Names what the bytes mean: only estimators of the same kind can read them.
    fn kind(&self) -> String;

    /// The belief, `[S, H, W]` as `f32`, then what its kind adds.
    fn to_bytes(&self) -> Vec<u8>;

    /// Goes on from the bytes of an estimator of the same kind. Returns false, and changes nothing, if they do not
    /// fit.
    fn restore(&mut self, bytes: &[u8]) -> bool;
}

/// An estimator that is told the hidden states.
pub trait Told {
    /// Takes in hidden states, shape `[H, W]`: X_k after a frame; X_{k+1} before a path, where they are known.
    ///
    /// # Errors
    /// If they are not states of the belief's model and grid.
    fn tell(&mut self, states: &Grid<u8>) -> Result<(), BeliefError>;
}

/// Why an estimator did not take in what was seen.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum EstimatorError {
    /// A frame that the belief rules out.
    #[error(transparent)]
    ZeroEvidence(#[from] ZeroEvidence),
    /// A network whose numbers are too large to compute with, or whose device fails.
    #[error("checkpoint: {0}")]
    Network(Box<dyn StdError + Send + Sync>),
}
