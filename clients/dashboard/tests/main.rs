//! One program: each would link the crate.

mod pictures;
mod player;
