//! Estimators, which turn frames into a belief about every cell (paper sections III.A to III.C). To add one, implement
//! [`Estimator`] in a file of this module.

pub mod bayes;
pub mod belief;
pub mod correlations;
pub mod estimator;
pub mod filter;
mod innovation;
pub mod kept_belief;
pub mod parameters;
pub mod prediction;
pub mod prior;
pub mod scoring;
pub mod spatial;
mod spread;
pub mod truth;

pub use bayes::ZeroEvidence;
pub use correlations::Correlations;
pub use estimator::{Estimator, EstimatorError, Filter, Handover, ObservationModel, Told};
pub use filter::BayesFilter;
pub use kept_belief::KeptBelief;
pub use prior::Prior;
pub use spatial::{SpatialFilter, correcting};
