//! Operators with hand-written kernels and gradients, for 32-bit floats on the CPU.
//!
//! Each is a candle `CustomOp` with a `bwd`, so models use them as any other operator and autograd goes
//! through them. The layers keep the stock operators beside them, which run on other devices and with other
//! numbers, and are what the tests compare with.
//!
//! Where the speed comes from: the first convolution and the loss touch visited cells only; channels that
//! dropout takes are neither stored nor computed; normalisation, ReLU and dropout are one pass; the recurrence
//! is one operator instead of a dozen for each step.

pub(crate) mod cell_loss;
pub(crate) mod conv;
mod cpu;
pub(crate) mod doubling;
pub(crate) mod drop_relu_norm;
pub(crate) mod gru_sequence;
pub(crate) mod norm;
mod planes;
mod product;
mod taps;
pub(crate) mod visited_conv;
