//! What the server and its clients agree on.

pub mod frame;
pub mod grid;
pub mod model;
pub mod path;
pub mod randomness;

pub use frame::{Coverage, Frame, UNOBSERVED};
pub use grid::{Cell, Grid, Probabilities, Shape};
pub use model::Model;
pub use path::Move;
