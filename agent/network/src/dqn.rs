//! The DQN of paper section III.E (eqs. 16 to 21): what the next path is for.
//!
//! It reads the autoencoder's hidden vector and gives the value of each objective, or it reads the numbers of each
//! candidate path and gives that path's value ([`DqnShape`]). Each transition has its own discount: at the end of an
//! episode, returns are of fewer steps ([`Track::end`]). The DQN stays on the CPU: its layers are so small that a copy to a
//! device and back takes longer.

mod learner;
mod state;
mod track;

pub use learner::{Dqn, DqnSettings, DqnShape};
pub use state::SavedDqn;
pub use track::{Track, Transition};
