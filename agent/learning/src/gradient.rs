//! Maximum likelihood for the parameters of a [`BayesFilter`](emberwatch_belief::estimation::BayesFilter): weights `w`,
//! observation matrix `O` and first belief, without a bias ([`Optimiser`]). Start with `parameters` in
//! `emberwatch_belief`, then read `recursion` for one pass and its derivatives, then `optimiser`.
//!
//! The data do not determine the scale of `w` (eq. 3 divides it out), the order of the states, and part of their
//! meaning. Parameter sets that predict all observations equally well are indistinguishable. For example, a learned
//! state that "often looks latent" may stand for the true latent state, which mostly looks normal. Two things fix the
//! labels: the initial parameters, in which state i looks like observation i, and a prior that the state with the
//! highest reward is observed almost surely.

mod adam;
mod convolution;
mod layout;
mod operator;
mod optimiser;
mod recursion;

pub use adam::Adam;
pub use optimiser::{Optimiser, Update};
pub use recursion::Recursion;
