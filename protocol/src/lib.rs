//! What the server and its clients agree on.

pub mod channels;
pub mod connection;
pub mod control;
pub mod frame;
pub mod grid;
pub mod message;
pub mod model;
pub mod observer;
pub mod path;
pub mod randomness;
pub mod wait;

pub use frame::{Coverage, Frame, UNOBSERVED};
pub use grid::{Cell, Grid, Probabilities, Shape};
pub use model::Model;
pub use path::Move;
