//! One test program: each separate one would have to link the crate.

mod golden;
mod model;
mod model_file;
