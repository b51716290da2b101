//! Learning while acting: a filter's parameters, the paper's networks, decisions; and their checkpoints.

pub mod belief;
pub mod checkpoint;
pub mod filter;
pub mod learned;
pub mod learners;
pub mod metrics;
pub mod replay;
pub mod reward;
pub mod tensorboard;
pub mod train;
