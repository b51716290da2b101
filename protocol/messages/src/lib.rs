//! The bytes and the JSON of PROTOCOL.md: what a server and its clients say to each other, and why a request fails.
//!
//! [`message`] and [`payload`] are the bytes of steps and samples, [`control`] is the JSON of everything rare,
//! [`recording`] keeps samples in a file. A [`client::Client`] flies robots of a [`backend`]: a server, or worlds in the
//! same process. Nothing here opens a channel. [`limits`] refuses more memory and threads than
//! the system has; [`interrupt`] ends waits.

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
pub mod limits;
pub mod message;
pub mod observation;
pub mod payload;
pub mod process;
pub mod recording;
pub mod sample;
