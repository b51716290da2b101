//! Tests of the real programs, `emberwatch-server` and `emberwatch-agent`, as a user runs them.
//!
//! Run `cargo build --workspace` first, because Cargo does not build another package's programs for a test. `src` has
//! shared code, `python` speaks the protocol through `wire_reference.py`, and `random_robot` is the example client.
//! Every other module tests one topic. Each test has its own instance, folder and deadline.
//! `cargo test -p tests -- --ignored` runs the tests that take minutes, such as kills at random moments, and the tests
//! that need Python (`scripts/test` installs it).

mod agent_beliefs;
mod c;
mod clients;
mod commands;
mod compare;
mod compliance;
mod crash;
mod frames;
mod handover;
mod hostile;
mod kills;
mod land;
mod logging;
mod places;
mod python;
#[expect(dead_code, reason = "the example's own main")]
#[path = "../protocol/examples/random_robot.rs"]
mod random_robot;
mod recorded_worlds;
mod recording;
mod restart;
mod security;
mod snapshots;
mod suite;
mod tasks;
mod teams;
mod training;
