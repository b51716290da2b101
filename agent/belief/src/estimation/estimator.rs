//! The interface of estimators, which turn frames into a belief about every cell (paper sections III.A to III.C).

use crate::estimation::bayes::ZeroEvidence;
use crate::estimation::belief::{Belief, BeliefError};
use emberwatch_model::{Frame, Grid};
use ndarray::Array2;
use std::any::Any;
use std::borrow::Cow;
use std::error::Error as StdError;
use thiserror::Error;

/// An estimator of one world's hidden states. In each step, [`Self::correct`] updates the belief with the frame, then
/// [`Self::predict`] moves the belief one step ahead. What only some kinds can do is in traits of their own.
pub trait Estimator: Send + Any {
    /// Corrects the belief with the frame of X_k (eq. 5).
    ///
    /// Robots over one cell in the same step read the same value. Merge their frames first, as in a team frame: two
    /// corrections would count one reading twice.
    ///
    /// # Errors
    /// If the frame is impossible under the belief. The belief is then unchanged.
    fn correct(&mut self, frame: &Frame) -> Result<(), EstimatorError>;

    /// Predicts the belief about X_{k+1} from the belief about X_k (eq. 6).
    fn predict(&mut self);

    /// Returns the belief: about X_k after [`Self::correct`], about X_{k+1} after [`Self::predict`].
    fn belief(&self) -> &Belief;
}

/// An estimator from whose belief observations can be predicted.
pub trait ObservationModel {
    /// Returns `P(y | x)`, shape `[S, O]`. `None` if it cannot be computed, as when a network's device failed.
    fn likelihood(&self) -> Option<Cow<'_, Array2<f64>>>;
}

/// A filter whose prediction another estimator can refine.
pub trait Filter: Estimator + ObservationModel + Handover {}

impl<T: Estimator + ObservationModel + Handover> Filter for T {}

/// An estimator whose state can be saved as bytes, and restored by another estimator of the same kind.
pub trait Handover {
    /// Returns a description of the byte format. Only estimators with the same description can read the bytes.
    fn kind(&self) -> String;

    /// Returns the belief, `[S, H, W]` as `f32`, followed by any data that is specific to the kind. Empty after a failed
    /// prediction: no estimator restores that.
    fn to_bytes(&self) -> Vec<u8>;

    /// Restores the state from the bytes of an estimator of the same kind. Returns false and changes nothing if the
    /// bytes do not fit.
    fn restore(&mut self, bytes: &[u8]) -> bool;
}

/// An oracle: an estimator that receives the hidden states.
pub trait Told {
    /// Receives the hidden states, shape `[H, W]`: X_k after each frame, and X_{k+1} before a path is planned, if
    /// X_{k+1} is already known.
    ///
    /// # Errors
    /// If the states do not fit the belief.
    fn tell(&mut self, states: &Grid<u8>) -> Result<(), BeliefError>;
}

/// The reason why an estimator rejected a frame.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum EstimatorError {
    /// The frame is impossible under the belief.
    #[error(transparent)]
    ZeroEvidence(#[from] ZeroEvidence),
    /// The estimator's network overflowed, or its device failed.
    #[error("checkpoint: {0}")]
    Network(Box<dyn StdError + Send + Sync>),
}
