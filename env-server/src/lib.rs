//! The Emberwatch server: simulates worlds and serves them to agents over shared memory.
//!
//! [`server`] is the loop on its channels. [`recording`] records what a server publishes, and publishes it again. Worlds,
//! leases and snapshots are in the crate `emberwatch-sim`.

#![allow(missing_docs, reason = "a program, which tests use as a library")]

pub mod flags;
pub mod recording;
pub mod server;
