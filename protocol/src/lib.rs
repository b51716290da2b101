//! The wire between the server and its clients: channels of shared memory by iceoryx2, connections, observers.
//!
//! A [`Client`] flies robots; `examples/random_robot.rs` is a whole program. Below it, a [`Connection`] takes the
//! requests in [`control`] and [`message`]. An [`observer`] reads what a server publishes, a [`recording`] what a file
//! holds of that. A [`responder`], [`channels`] and [`failed_connections`] are for those who serve worlds.
//!
//! The messages are in the crate `emberwatch-messages`, the mathematics of the worlds in `emberwatch-model`; a client
//! finds what it needs of both here. PROTOCOL.md describes the wire for other languages. Words: a *world* is the hidden
//! state of one grid; a *step* `k` flies one path with each robot and moves the world once; a *frame* holds the
//! observations of a step; a *lease* is the right to fly robots.

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
    UNOBSERVED, built_in, dynamics, frame, grid, path, randomness, task, transition, vectors,
};
pub use wire::connection::{self, Connection};
pub use wire::{
    agent_belief, channels, cleanup, failed_connections, feed, observer, responder, shared_memory,
    turn, wait,
};

/// A client of a server.
pub type Client = client::Client<Connection>;

#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
