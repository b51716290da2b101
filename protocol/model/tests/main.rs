//! One program: each would link the crate.

mod golden;
mod hostile;
mod model;
mod model_file;
