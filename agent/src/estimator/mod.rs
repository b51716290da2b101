//! Estimators: from frames to a belief about every cell (paper sections III.A to III.C).

pub mod filter;
pub mod prior;

pub use filter::{Filter, ZeroEvidence};
pub use prior::Prior;
