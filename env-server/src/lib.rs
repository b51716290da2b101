//! The Emberwatch server: simulates worlds and serves them to agents over shared memory.
//!
//! One step, in reading order: [`world`] (hidden states, robot, noise), [`simulator`] (leases; request in, answer
//! out), [`server`] (shared memory and the loop). [`snapshot`] saves worlds. [`recording`] records what a server
//! publishes, and publishes it again. [`embedded`] has worlds inside the process that uses them.

#![allow(missing_docs, reason = "a program, which tests use as a library")]

pub mod bounds;
pub mod config;
pub mod embedded;
pub mod flags;
pub mod given;
pub mod limits;
pub mod recording;
pub mod server;
pub mod simulator;
pub mod snapshot;
pub mod states_file;
pub mod world;
