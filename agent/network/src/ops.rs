//! Operators with hand-written kernels and gradients, for 32-bit floats on the CPU.
//!
//! Each layer also has an implementation with candle's operators, which runs on other devices and number types. Tests
//! compare the two implementations.
//!
//! - [`conv`]: the arithmetic of plain and transposed convolutions, one frame at a time, by matrix [`product`]s.
//! - [`image_conv`], [`doubled_sum`]: the U-Net's convolution with bias, ReLU and residual, and its upsampling.
//! - [`chain`]: the autoencoder's encoder and decoder, which are sequences of convolutions ([`stage`]) with dropout,
//!   normalisation ([`norm`]) and ReLU ([`activation`]) between them.
//! - [`cell_loss`]: the loss at visited cells.
//! - [`gru_sequence`]: a GRU over a sequence.

pub(crate) mod activation;
pub(crate) mod cell_loss;
pub(crate) mod chain;
pub(crate) mod conv;
pub(crate) mod cpu;
pub(crate) mod doubled_sum;
pub(crate) mod gru_sequence;
pub(crate) mod image_conv;
pub(crate) mod norm;
mod product;
pub(crate) mod stage;
