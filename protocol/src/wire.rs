//! The wire: what travels between processes, and how.
//!
//! [`message`], [`payload`] and [`control`] are the messages; [`channels`] the services that carry them;
//! [`connection`] and [`client`] a client's side, [`responder`] the answering side, [`observer`] a reader's side.
//! [`node`], [`turn`] and [`cleanup`] create and remove channels, [`shared_memory`] gives them memory; [`wait`] is the
//! bounded wait. [`recording`] keeps samples in a file.

pub mod agent_belief;
mod channel_files;
pub mod channels;
pub mod cleanup;
pub mod client;
mod codes;
pub mod connection;
pub mod control;
mod directory;
mod error;
mod exchange;
pub mod failed_connections;
pub mod feed;
mod hello;
pub mod interrupt;
mod json;
pub mod message;
mod node;
pub mod observer;
mod own_nodes;
pub mod payload;
mod poll;
pub(crate) mod process;
pub mod recording;
mod resources;
pub mod responder;
pub mod shared_memory;
mod spinning;
mod texts;
pub mod turn;
pub mod wait;
