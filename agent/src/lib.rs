//! The agent of Emberwatch: estimates hidden states, plans paths, acts on a server, and compares policies.
//!
//! The modules from top to bottom; each uses only modules below it:
//!
//! - [`cli`] and `commands` -- the command line and its subcommands
//! - [`benchmark`] -- runs and scores policies on the same worlds
//! - [`acting`] -- acts on one world of a running server
//! - `training` -- trains learners while they act, with metrics
//! - [`charts`] -- charts as SVG
//! - [`client`] -- communication with the server
//! - `flags` -- flags for the agent's settings
//! - [`process`] -- the allocator and candle's thread counts
//!
//! Policies, estimators, learners and checkpoints are in the crate `emberwatch-learning`.

#![allow(missing_docs, reason = "a program: the names explain themselves")]

pub mod acting;
pub mod benchmark;
pub mod charts;
pub mod cli;
pub mod client;
mod commands;
mod flags;
pub mod process;
mod training;
