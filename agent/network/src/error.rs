//! Errors of the networks.

use thiserror::Error;

/// A number that is not finite, after which training must stop.
#[derive(Debug, Clone, Error, PartialEq)]
#[error("update {update}: expected finite numbers, got NaN or infinity in {tensor}")]
pub struct NotFinite {
    /// Number of updates before the failed one.
    pub update: u64,
    /// Name of the tensor. Gradients have the prefix `gradient of`, and the loss is named `loss`.
    pub tensor: String,
}

/// The reason why a step or an update failed. A failed step or update changes nothing.
#[derive(Debug, Clone, Error, PartialEq)]
pub enum NetworkError {
    /// A number is not finite.
    #[error(transparent)]
    NotFinite(#[from] NotFinite),
    /// The device failed, for example because it ran out of memory.
    #[error("the network's device: {0}")]
    Device(String),
}

impl From<candle_core::Error> for NetworkError {
    fn from(error: candle_core::Error) -> Self {
        Self::Device(error.to_string())
    }
}
