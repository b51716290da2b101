//! What the server and its clients agree on: the mathematics of the paper ([`model`], [`grid`], [`path`], [`frame`],
//! [`dynamics`], [`transition`]), and messages and channels.
//!
//! A [`Client`] flies robots; `examples/random_robot.rs` is a whole program. Below it, a [`Connection`] takes the
//! requests in [`control`] and [`message`]. An [`observer`] reads what a server publishes, a [`recording`] what a file
//! holds of that. A [`responder`], [`channels`] and [`failed_connections`] are for those who serve worlds. A [`task`] is
//! a world with a name. [`limits`] refuses more memory and threads than the system has.
//!
//! PROTOCOL.md describes the wire for other languages. Words: a *world* is the hidden state of one grid; a *step* `k`
//! flies one path with each robot and moves the world once; a *frame* holds the observations of a step; a *lease* is the
//! right to fly robots.

pub mod limits;
pub mod model;
pub mod program;
pub mod task;
pub mod throttle;
mod wire;

pub use model::dynamics::{self, Dynamics};
pub use model::frame::{self, Coverage, Frame, UNOBSERVED};
pub use model::grid::{self, Cell, Grid, Probabilities, Shape};
pub use model::path::{self, Move};
pub use model::transition::{self, Transition};
pub use model::{Airspace, Model, randomness, vectors};
pub use wire::client::{self, Client};
pub use wire::connection::{self, Connection};
pub use wire::{
    agent_belief, channels, cleanup, control, failed_connections, feed, interrupt, message,
    observer, payload, recording, responder, shared_memory, turn, wait,
};

#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
