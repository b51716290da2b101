//! What tests, benchmarks and examples share: programs as children, the wire byte by byte, hostile input.

#![allow(missing_docs, reason = "tests, which share it")]

pub mod attacker;
pub mod fuzz;
pub mod harness;
pub mod meter;
pub mod mirror;
mod programs;
pub mod report;
pub mod siege;
pub mod stepper;
pub mod wire;
