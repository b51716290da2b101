//! `record` and `replay`: write what a server publishes to a file, and publish it again.

mod pace;
mod recorder;
mod replay;
mod replies;

pub use recorder::{RecordOptions, RecordSummary, record};
pub use replay::{ReplayOptions, replay};
