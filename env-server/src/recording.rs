//! `record` and `replay`: what a server publishes, into a file and out of it.

mod pace;
mod recorder;
mod replay;
mod replies;

pub use recorder::{RecordOptions, RecordSummary, record};
pub use replay::{ReplayOptions, replay};
