//! Hostile bytes for every decoder: one function per format, which checks what must hold of any bytes.
//!
//! A [`Target`] is a line of [`TARGETS`]. [`campaign`] runs it on stable Rust over mutations
//! ([`mutation`]) of its corpus, `fuzz/corpus/<name>/`; `fuzz/` runs the same functions under libFuzzer.

mod besieged;
pub mod campaign;
mod files;
mod messages;
pub mod mutation;
mod requests;
mod target;
mod targets;
mod worlds;

pub use target::{Kind, Seed, Target};
pub use targets::{TARGETS, decode, named};
