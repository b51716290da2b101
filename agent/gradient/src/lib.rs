//! The exact gradient of a Bayes filter's log-likelihood. [`Recursion`] runs the filter through a window of frames and
//! back, and returns the derivatives with respect to the filter's parameters, the
//! [`Tables`](emberwatch_belief::estimation::parameters::Tables).
//!
//! It is a separate crate, because its loops compile slowly, into one large function for each instruction set, and
//! `emberwatch-learning` then needs no optimisation in tests.

mod convolution;
mod layout;
mod operator;
mod recursion;

pub use recursion::{Outcome, Recursion, Sighting};
