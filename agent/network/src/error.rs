//! What may go wrong in a network.

use thiserror::Error;

/// A number that is not finite: training must stop.
#[derive(Debug, Clone, Error, PartialEq)]
#[error("update {update}: expected finite numbers, got one that is not in {tensor}")]
pub struct NotFinite {
    /// Updates before this one.
    pub update: u64,
    /// The tensor, a gradient's with the prefix `gradient of`; or the loss.
    pub tensor: String,
}

/// Why a step or an update failed; nothing has changed then.
#[derive(Debug, Clone, Error, PartialEq)]
pub enum NetworkError {
    /// The numbers.
    #[error(transparent)]
    NotFinite(#[from] NotFinite),
    /// A saved transition of another DQN.
    #[error("dqn.transitions: {at}: expected {expected}, got {got}")]
    Transition {
        /// Which one, the oldest first.
        at: usize,
        /// What it must have.
        expected: String,
        /// What it has.
        got: String,
    },
    /// The device, as for want of memory.
    #[error("the network's device: {0}")]
    Device(String),
}

impl From<candle_core::Error> for NetworkError {
    fn from(error: candle_core::Error) -> Self {
        Self::Device(error.to_string())
    }
}
