//! The dynamic autoencoder of the paper (sections III.B and III.C, eqs. 7 to 11), trained on a CPU.
//!
//! In reading order: [`shape`] (sizes), [`parameters`] (named tensors), [`window`] (what was seen),
//! [`encoder`] with [`conv`], [`gru`], [`decoder`] with [`seed`], [`deconv`] and [`visited`], [`loss`],
//! [`gradient`] (all of it, there and back), [`adam`], [`autoencoder`] (what the rest of the agent uses).
//!
//! Kernels are plain Rust on slices. As candle `CustomOp`s they would read worse: such an operator takes
//! three tensors and keeps no state, while ours skip channels by the dropout masks and hand statistics
//! and maps from the forward to the backward pass. candle stores ([`checkpoint`]) and, in the tests,
//! its stock layers and its automatic derivatives are what the kernels are compared with.
//!
//! Where the speed comes from, with the same mathematics:
//!
//! 1. The first convolution, and the last with softmax and loss, only touch visited cells.
//! 2. Dropout takes half of the channels, so a layer needs a quarter of its products. What lost channels
//!    leave behind is a constant, see [`deconv`].
//! 3. Stride-2 transposed convolutions are four small correlations with pixels in vector lanes.
//! 4. A window's maps do not fit the caches: what is cheap is computed anew instead of fetched, what is
//!    mostly zero is kept as a list, and numbers begin where a cache line does.
//! 5. The recurrence runs over the whole window at once.
//! 6. [`lanes`] compiles everything for the CPU at hand; [`parallel`] uses all cores, and the number of
//!    threads changes no bit.

pub mod adam;
pub mod autoencoder;
mod batch_norm;
pub mod checkpoint;
mod conv;
mod correlation;
mod decoder;
mod deconv;
pub mod dqn;
mod dropout;
mod encoder;
mod gradient;
mod gru;
mod inference;
mod lanes;
mod loss;
mod parallel;
mod parameters;
mod perceptron;
mod product;
pub mod replay;
mod seed;
mod shape;
mod visited;
mod window;
#[cfg(target_arch = "x86_64")]
mod x86;

pub use adam::{Adam, AdamSettings};
pub use autoencoder::{Autoencoder, AutoencoderSettings, NotFinite, StepError};
pub use checkpoint::CheckpointError;
pub use dqn::{Dqn, DqnInput, DqnSettings, Track, Transition};
pub use dropout::{ChannelMask, Dropout};
pub use gradient::Trajectory;
pub use loss::{LossKind, LossSettings};
pub use parameters::Tensors;
pub use replay::Replay;
pub use shape::NetworkShape;
pub use window::Window;
