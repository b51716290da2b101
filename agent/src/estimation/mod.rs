//! From frames to a belief about every cell (paper sections III.A to III.C).
//!
//! A new estimator is one file with an [`Estimator`], and a line where policies get theirs
//! ([`crate::acting::registry`]).

pub mod autoencoder;
pub mod bayes;
pub mod belief;
pub mod correlations;
pub mod estimator;
pub mod filter;
pub mod first_belief;
pub mod follower;
mod innovation;
pub mod parameters;
pub mod prior;
pub mod scoring;
pub mod spatial;
mod spread;
pub mod truth;

pub use autoencoder::AutoencoderEstimator;
pub use bayes::ZeroEvidence;
pub use correlations::Correlations;
pub use estimator::{Estimator, EstimatorError};
pub use filter::BayesFilter;
pub use follower::Follower;
pub use prior::Prior;
pub use spatial::SpatialFilter;
