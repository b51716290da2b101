//! Estimates, plans and acts on an Emberwatch server, and compares ways to do so.
//!
//! Rooms, each using only those below it:
//!
//! - [`cli`] and `commands` -- flags in, words out
//! - [`benchmark`] -- policies on the same worlds, scored
//! - [`acting`] -- one world of a running server
//! - `training` -- the loop that learns while acting, its metrics and events
//! - [`client`] -- the ends of the wire
//! - `flags` -- settings as flags
//! - [`process`] -- the allocator and candle's threads
//!
//! Policies, estimators, learners and checkpoints are in the crate `emberwatch-learning`.

#![allow(missing_docs, reason = "a program: what names say is not said again")]

pub mod acting;
pub mod benchmark;
pub mod cli;
pub mod client;
mod commands;
mod flags;
pub mod process;
mod training;
