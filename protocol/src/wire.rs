//! The wire: transports messages between processes.
//!
//! [`channels`] are the services that carry the messages of the crate `emberwatch-messages`. [`connection`] is a
//! client's side, [`responder`] the answering side, and [`observer`] a reader's side. [`node`], [`turn`] and
//! [`cleanup`] create and remove channels, and [`shared_memory`] allocates their memory. [`wait`] waits with a
//! deadline.

pub mod agent_belief;
mod channel_files;
pub mod channels;
pub mod cleanup;
pub mod connection;
mod directory;
mod exchange;
pub mod failed_connections;
pub mod feed;
mod ipc;
mod node;
pub mod observer;
mod own_nodes;
mod poll;
pub(crate) mod process;
mod resources;
pub mod responder;
pub mod shared_memory;
mod spinning;
mod texts;
pub mod turn;
pub mod wait;
