//! Simulated worlds: requests in, answers out, without channels.
//!
//! One step, in reading order: [`world`] (hidden states, robot, noise), [`simulator`] (leases; request in, answer out).
//! [`snapshot`] saves worlds. [`config`] has the settings, [`given`] those given by name. [`embedded`] has worlds
//! inside the process that uses them.

#![allow(
    missing_docs,
    reason = "the server's inside: what names say is not said again"
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
