//! One program: each would link the crate.

mod golden;
mod model;
mod model_file;
