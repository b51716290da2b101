//! One program: each would link the crate.

mod hostile;
mod lease;
mod recording;
