//! An agent at its world, and the one step that every command takes: plan, fly, correct, look, predict.

pub mod agent;
mod robot;

pub use robot::{Robot, Seen, Turn, in_parallel, step};
