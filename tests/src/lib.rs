//! Shared code of tests, benchmarks and examples: child processes, raw protocol messages, hostile input.

#![allow(missing_docs, reason = "tests, which share it")]

pub mod fuzz;
pub mod harness;
pub mod meter;
mod programs;
pub mod siege;
pub mod wire;
