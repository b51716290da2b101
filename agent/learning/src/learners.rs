//! What learns while it acts, as a training loop drives it. Pure: frames in, paths out.

mod base;
pub mod decisions;
pub mod filter;
pub mod network;
pub mod neural;
#[cfg(test)]
mod tests;

pub use self::base::{Learner, Worlds};
