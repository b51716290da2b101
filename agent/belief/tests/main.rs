//! All integration tests in one program, so that the crate is linked only once.

mod golden;
mod planning;
