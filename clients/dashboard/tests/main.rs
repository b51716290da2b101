//! One program: each would link the crate.

mod land;
mod pictures;
mod player;
