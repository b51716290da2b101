//! Shows a running instance, or a recording, in a browser. Read-only.
//!
//! In reading order: a [`watcher`] (for an instance) or a [`player`] (for a recording) fills the [`album`], which keeps
//! the last few thousand steps of each world. Over a WebSocket to the [`server`], a browser requests one [`picture`] at
//! a time, at its own pace, and the [`page`] draws it. [`access`] refuses pages of other sites.

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
