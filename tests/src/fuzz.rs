//! Hostile bytes for every decoder: one function per format, which checks what must hold of any bytes.
//!
//! A [`Target`] is a line of [`TARGETS`]. `tests/decoders.rs` runs it on damaged copies of its corpus,
//! `fuzz/corpus/<name>/`; `fuzz/` runs the same functions under libFuzzer.

mod besieged;
mod files;
mod messages;
mod requests;
mod target;
mod targets;
mod worlds;

pub use target::{Seed, Target};
pub use targets::{TARGETS, decode, named};
