//! Shows in a browser what happens on an instance, or what a recording holds. Read-only.
//!
//! In reading order: a [`watcher`] (a running instance) or a [`player`] (a recording) fills the [`album`],
//! which keeps the last few thousand steps of each world; a browser asks for one [`picture`] after the other
//! over a WebSocket of the [`server`], at its own pace; [`page`] is what draws them. [`access`] refuses pages of other
//! sites.

#![allow(missing_docs, reason = "a program, which tests use as a library")]

pub mod access;
pub mod album;
pub mod entry;
mod last_seen;
pub mod page;
pub mod picture;
pub mod player;
pub mod scene;
pub mod server;
pub mod watcher;
