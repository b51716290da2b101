//! Parameters for a [`BayesFilter`](emberwatch_belief::estimation::BayesFilter) that are learned: weights `w`, observation matrix `O`
//! and first belief that maximise the likelihood of what was seen ([`Optimiser`]; no bias). Read `parameters`, then
//! `recursion` for one pass and its derivatives, then `optimiser`.
//!
//! What the data do not tell: the scale of `w` (eq. 3 divides it out), and the order and, in part, the
//! meaning of the states. Two parameter sets that predict every observation alike cannot be told
//! apart; so a cell that "often looks latent" may stand for the true latent one, whose cells mostly
//! look normal. Labels are anchored where learning starts (state i looks like observation i), and
//! by a prior on the state that pays most: it is seen almost surely.

mod adam;
mod convolution;
mod layout;
mod operator;
mod optimiser;
mod recursion;

pub use adam::Adam;
pub use optimiser::{Optimiser, Update};
pub use recursion::Recursion;
