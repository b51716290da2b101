//! The Emberwatch server: simulates worlds and serves them to agents over shared memory.
//!
//! [`server`] contains the main loop and the channels. [`recording`] records what a server publishes. Worlds, leases
//! and snapshots are in the crate `emberwatch-sim`.

#![allow(missing_docs, reason = "a program; only its tests use the library")]

pub mod recording;
pub mod server;
