//! The exact gradient of a Bayes filter's log-likelihood. [`Recursion`] runs the filter through a window of frames and
//! back, and returns the derivatives with respect to the filter's parameters, the
//! [`Tables`](emberwatch_belief::estimation::parameters::Tables).
//!
//! This is a crate of its own because its loops are one large function for each instruction set: the rest of the agent
//! compiles quickly without them.

mod convolution;
mod layout;
mod operator;
mod recursion;

pub use recursion::{Outcome, Recursion, Sighting};
