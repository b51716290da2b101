//! All integration tests in one program: separate programs would each link the crate.

mod architecture;
mod wire;
