//! One program: each would link the crate.

mod architecture;
mod golden;
mod hostile;
mod model;
mod model_file;
mod recording;
mod wire;
