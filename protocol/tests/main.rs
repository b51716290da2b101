//! One test program: each separate one would have to link the crate.

mod architecture;
mod wire;
