//! The real processes together: `emberwatch-server` and `emberwatch-agent` as a user runs them.
//!
//! `cargo build --workspace` first: cargo does not build another package's programs for a test.
//! What they share is in `src`; `python` lets `wire_reference.py` speak the protocol, `random_robot` is the example of a
//! client; every other module is a group of facts. Each test has an instance, a folder and a deadline of its own.
//! `cargo test -p tests -- --ignored` adds what takes minutes, such as deaths at random moments, and what needs Python
//! (`scripts/test` installs it).

mod agent_beliefs;
mod autoencoder;
mod commands;
mod compare;
mod compliance;
mod crash;
mod determinism;
mod episodes;
mod files;
mod frames;
mod handover;
mod hostile;
mod kills;
mod land;
mod lease;
mod places;
mod python;
#[expect(dead_code, reason = "the example's own main")]
#[path = "../protocol/examples/random_robot.rs"]
mod random_robot;
mod recorded_worlds;
mod recording;
mod replays;
mod restart;
mod security;
mod snapshots;
mod suite;
mod tasks;
mod teams;
mod trained_decisions;
mod trained_neural;
mod training;
mod trainings;
