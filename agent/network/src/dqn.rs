//! The DQN of paper section III.E (eqs. 16 to 21), which chooses the objective of the next path.
//!
//! It computes the value of each objective from the autoencoder's hidden vector, or the value of each candidate path
//! from that path's features ([`DqnShape`]). Each transition has its own discount, because returns span fewer steps at
//! the end of an episode ([`Track::end`]). The DQN always runs on the CPU: its layers are so small that copies to a
//! device and back would take longer.

mod learner;
mod state;
mod track;

pub use learner::{Dqn, DqnSettings, DqnShape};
pub use track::{Track, Transition};
