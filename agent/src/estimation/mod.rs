//! From frames to a belief about every cell (paper sections III.A to III.C).
//!
//! A new estimator is one file with an [`Estimator`], and a line where policies get theirs
//! ([`crate::acting::registry`]).

pub mod autoencoder;
pub mod belief;
pub mod dqn_input;
pub mod estimator;
pub mod filter;
pub mod first_belief;
pub mod parameters;
pub mod prior;
pub mod scoring;
pub mod summary;
pub mod truth;

pub use autoencoder::{AutoencoderEstimator, Follower};
pub use estimator::{Estimator, EstimatorError};
pub use filter::{BayesFilter, ZeroEvidence};
pub use prior::Prior;
