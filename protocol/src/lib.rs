//! The wire between a server and its clients: channels over shared memory (iceoryx2), connections and observers.
//!
//! A [`Client`] flies robots: it sends the requests of [`control`] and [`message`] over a [`Connection`]. A complete
//! program is `examples/random_robot.rs`. An [`observer`] reads the samples that a server publishes, and a
//! [`recording`] stores them in a file. [`responder`], [`channels`] and [`failed_connections`] are for servers.
//!
//! The crate `emberwatch-messages` contains the messages, and `emberwatch-model` the mathematics of the worlds. The
//! parts of both crates that a client needs are re-exported here. PROTOCOL.md describes the wire for other languages.
//!
//! Terms: a *world* is the hidden state of one grid. A *step* `k` flies one path with each robot and moves the world
//! once. A *frame* contains the observations of a step. A *lease* is the right to fly robots.

#![allow(missing_docs, reason = "self-explanatory names need no docs")]

#[cfg(feature = "program")]
mod flags;
#[cfg(feature = "program")]
mod logging;
#[cfg(feature = "program")]
pub mod program;
pub mod throttle;
mod wire;

pub use emberwatch_messages::{
    backend, client, control, interrupt, lease, limits, message, payload, recording,
};
pub use emberwatch_model as model;
pub use emberwatch_model::{
    Airspace, Cell, Coverage, Dynamics, Frame, Grid, Model, Move, Probabilities, Shape, Transition,
    UNOBSERVED, built_in, dynamics, frame, grid, path, randomness, settings, task, transition,
    vectors,
};
pub use wire::connection::{self, Connection};
pub use wire::{
    agent_belief, channels, cleanup, failed_connections, feed, observer, responder, shared_memory,
    turn, wait,
};

pub type Client = client::Client<Connection>;

#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
