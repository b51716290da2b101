//! One program: each would link the crate.

mod architecture;
mod wire;
