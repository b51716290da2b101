//! Maximum-likelihood estimation for a [`BayesFilter`](emberwatch_belief::estimation::BayesFilter) without a bias:
//! [`Optimiser`] learns the weights `w`, the observation matrix `O` and the first belief. Read `parameters` in
//! `emberwatch_belief` first, then [`Recursion`](emberwatch_gradient::Recursion) for one pass through a window of frames
//! and its derivatives, then `optimiser`.
//!
//! The data determine neither the scale of `w` (eq. 3 divides it out) nor the order of the states, and the meaning of
//! the states only in part. Parameter sets that predict all observations equally well are indistinguishable. For
//! example, a learned state that "often looks latent" may stand for the true latent state, which mostly looks normal.
//! Two things determine which state is which: the initial parameters, in which state i looks like observation i, and a
//! prior under which the observation of the state with the highest reward is almost certain.

mod adam;
mod optimiser;

pub use adam::Adam;
pub use optimiser::{Optimiser, Update};
