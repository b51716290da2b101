//! One program: each would link the crate.

mod golden;
mod planning;
