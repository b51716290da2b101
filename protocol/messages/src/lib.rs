//! The messages of PROTOCOL.md, as bytes and JSON, and the errors of requests.
//!
//! [`message`] and [`payload`] define the bytes of steps and samples, and [`control`] the JSON of all other requests.
//! [`recording`] stores samples in a file. A [`client::Client`] flies the robots of a [`backend`]: a server, or worlds
//! in the same process. This crate opens no channels. [`limits`] rejects requests for more memory or threads than the
//! system allows, and [`interrupt`] ends waits.

#![allow(missing_docs, reason = "self-explanatory names need no docs")]

pub mod agent_belief;
pub mod backend;
pub mod capacity;
pub mod client;
mod codes;
pub mod control;
pub mod errors;
mod hello;
pub mod instance;
pub mod interrupt;
mod json;
pub mod lease;
pub mod left_belief;
pub mod limits;
pub mod message;
pub mod observation;
pub mod payload;
pub mod process;
pub mod recording;
pub mod sample;
