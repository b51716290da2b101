//! One program: each would link the crate.

mod documents;
mod states_file;
