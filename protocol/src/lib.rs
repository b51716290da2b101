//! What the server and its clients agree on: the model and what it does, paths and frames, and the
//! wire.
//!
//! Read [`grid`], [`model`], [`dynamics`] (the world) and [`transition`] (beliefs) for the model of
//! the paper; [`path`] and [`frame`] for what a robot does and sees; [`message`], [`control`] and
//! [`decisions`] for what travels; [`channels`], [`connection`], [`responder`], [`observer`] and
//! [`wait`] for how, and [`recording`] for keeping it in a file. PROTOCOL.md says
//! the same for other languages. Words: a *world* is the hidden state of one grid; a *step* `k` flies
//! one path and moves the world once; a *frame* is what was seen; a *lease* is the right to act.

pub mod channels;
pub mod cleanup;
pub mod connection;
pub mod control;
pub mod decisions;
pub mod dynamics;
pub mod frame;
pub mod grid;
mod lanes;
pub mod message;
mod mixture;
pub mod model;
mod node;
pub mod observer;
pub mod outlook;
pub mod path;
pub mod program;
pub mod randomness;
pub mod recording;
pub mod responder;
mod spinning;
pub mod transition;
pub mod turn;
pub mod wait;

pub use connection::Connection;
pub use dynamics::Dynamics;
pub use frame::{Coverage, Frame, UNOBSERVED};
pub use grid::{Cell, Grid, Probabilities, Shape};
pub use model::Model;
pub use path::Move;
pub use transition::Transition;
