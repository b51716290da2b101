//! Simulated worlds that answer requests, without channels.
//!
//! To follow one step, read [`world`] (hidden states, robots, sensor noise), then [`simulator`] (leases, requests,
//! replies). [`snapshot`] saves worlds. [`config`] defines the settings. [`embedded`] runs worlds inside
//! the process that uses them.

#![allow(
    missing_docs,
    reason = "internals of the server: docs that would only repeat a name are left out"
)]

pub mod config;
pub mod embedded;
pub mod limits;
pub mod rate;
pub mod results;
pub mod simulator;
pub mod snapshot;
pub mod states_file;
pub mod world;
