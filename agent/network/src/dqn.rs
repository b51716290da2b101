//! The DQN of paper section III.E (eqs. 16 to 21): which objective the next path is for.
//!
//! Its input is the autoencoder's hidden vector, or any other summary of the belief. A transition is
//! never terminal: episodes are cut off, the world goes on. It stays on the CPU: its layers are so small
//! that a copy to a device and back takes longer.

mod learner;
mod state;
mod track;

pub use learner::{Dqn, DqnSettings};
pub use state::SavedDqn;
pub use track::{Track, Transition};
