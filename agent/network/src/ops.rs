//! Operators with hand-written kernels and gradients, for 32-bit floats on the CPU.
//!
//! The layers keep the stock operators beside them, which run on other devices and with other numbers, and are what the
//! tests compare with. There are four:
//!
//! - convolutions, plain and transposed, one frame at a time ([`conv`], on [`product`]s of matrices);
//! - one of images, with bias, ReLU and residual, for the U-Net ([`image_conv`]), and its doubling ([`doubled_sum`]);
//! - chains of convolutions with dropout, normalisation and ReLU between them, for the autoencoder ([`chain`]), and its
//!   loss at visited cells ([`cell_loss`]);
//! - a GRU over a sequence ([`gru_sequence`]).

pub(crate) mod cell_loss;
pub(crate) mod chain;
pub(crate) mod conv;
pub(crate) mod cpu;
pub(crate) mod doubled_sum;
pub(crate) mod gru_sequence;
pub(crate) mod image_conv;
pub(crate) mod norm;
mod product;
