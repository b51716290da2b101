//! What the server and its clients agree on.

pub mod dynamics;
pub mod frame;
pub mod grid;
mod mixture;
pub mod model;
pub mod path;
pub mod randomness;
pub mod transition;

pub use dynamics::Dynamics;
pub use frame::{Coverage, Frame, UNOBSERVED};
pub use grid::{Cell, Grid, Probabilities, Shape};
pub use model::Model;
pub use path::Move;
pub use transition::Transition;
