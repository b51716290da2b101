//! Operators with hand-written kernels and gradients, for 32-bit floats on the CPU.
//!
//! Each computes its result and knows its gradients; `cpu::derived` makes it a candle operator, so autograd
//! goes through them. The layers keep the stock operators beside them, which run on other devices and with
//! other numbers, and are what the tests compare with.
//!
//! Where the speed comes from: the first convolution, the last doubling and the loss touch visited cells only;
//! channels that dropout takes from the decoder are neither stored nor computed; what lies between the
//! convolutions of encoder and decoder is no tensor, and worked on while it is in the caches; the recurrence is
//! one operator instead of a dozen for each step.

pub(crate) mod cell_loss;
mod conv;
mod cpu;
pub(crate) mod decoder;
mod doubling;
pub(crate) mod encoder;
pub(crate) mod gru_sequence;
pub(crate) mod image_conv;
pub(crate) mod norm;
mod product;
mod taps;
mod visited_conv;
