//! Simulated worlds that answer requests, without channels.
//!
//! To follow one step, read [`world`] (hidden states, robots, sensor noise), then [`simulator`] (leases, requests,
//! replies). [`snapshot`] saves worlds. [`config`] defines the settings, and [`given`] replaces them by name.
//! [`embedded`] runs worlds inside the process that uses them.

#![allow(
    missing_docs,
    reason = "internals of the server: docs that would only repeat a name are left out"
)]

pub mod bounds;
pub mod config;
pub mod embedded;
pub mod given;
pub mod limits;
pub mod rate;
pub mod results;
pub mod simulator;
pub mod snapshot;
pub mod states_file;
pub mod world;
