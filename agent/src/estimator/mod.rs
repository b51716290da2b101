//! Estimators: from frames to a belief about every cell (paper sections III.A to III.C).

mod autoencoder;
pub mod filter;
pub mod learned_filter;
pub mod prior;

pub use autoencoder::{Follower, StepError};
pub use filter::{Filter, ZeroEvidence};
pub use learned_filter::LearnedFilter;
pub use prior::Prior;
