//! Estimates, plans and acts on an Emberwatch server, and compares ways to do so.
//!
//! Rooms, each using only those below it:
//!
//! - `commands` (of the program): flags in, words out
//! - [`benchmark`] -- policies on the same worlds, scored
//! - [`acting`] -- one world of a running server, and plans for a learner outside
//! - [`learning`] -- models that are learned while acting, and their checkpoints
//! - [`rollout`] -- an agent, and the one step that all of these take
//! - [`client`] -- the ends of the wire
//! - [`config`] -- settings
//! - [`mod@file`] -- files written whole or not at all
//! - [`policy`] -- policies by name
//! - [`estimation`] -- estimators that need networks; the others are in the crate `emberwatch-belief`

#![allow(missing_docs, reason = "a program: what names say is not said again")]

pub mod acting;
pub mod benchmark;
pub mod client;
pub mod config;
pub mod estimation;
pub mod file;
pub mod learning;
pub mod policy;
pub mod rollout;
