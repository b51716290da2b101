//! All integration tests in one program: separate programs would each link the crate.

mod golden;
mod model;
mod model_file;
