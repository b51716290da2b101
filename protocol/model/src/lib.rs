//! The hidden Markov model of the paper: its parameters, its mathematics, and a robot's moves and observations.
//!
//! This crate knows nothing of messages. All other modules index a [`grid`]. [`dynamics`] draws hidden states, and
//! [`transition`] applies the same operator to beliefs. [`path`] and [`frame`] represent a robot's moves and
//! observations. [`mod@settings`] define worlds, a [`task`] is a named set of worlds, and [`built_in`] contains the models,
//! tasks and recorded states that ship with the programs. [`text`] reads settings and model files.

#![allow(missing_docs, reason = "self-explanatory names need no docs")]

mod airspace;
pub mod built_in;
mod cell_map;
mod check;
mod description;
pub mod dynamics;
pub mod file;
pub mod frame;
pub mod grid;
pub mod hazards;
pub mod maps;
mod npy;
mod parameters;
mod parts;
pub mod path;
pub mod randomness;
pub mod settings;
pub mod task;
pub mod text;
pub mod transition;
pub mod vectors;

pub use airspace::Airspace;
pub use cell_map::CellMap;
pub use description::{DescribedState, Description};
pub use dynamics::Dynamics;
pub use file::{
    KernelEntry, MAX_KERNEL_SIDE, MAX_RADIUS, MAX_VALUES, ModelError, ModelFile, ObservationEntry,
    SensorEntry, StateEntry, TRANSITIONS_FORM, TransitionEntry, parse_color,
};
pub use frame::{Coverage, Frame, UNOBSERVED};
pub use grid::{Cell, Grid, Probabilities, Shape};
pub use hazards::Hazards;
pub use maps::MapsEntry;
pub use parameters::{Model, Ratio, Rule, UnevenPlace};
pub use parts::Parts;
pub use path::Move;
pub use transition::Transition;
