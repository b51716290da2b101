//! The paper's networks as candle models: the dynamic autoencoder (sections III.B and III.C, eqs. 7 to 11)
//! and the DQN (section III.E); and the neural belief, which learns by the autoencoder's loss and keeps space.
//!
//! In reading order: [`Network`] (the model: encoder, [`Gru`], decoder, observation matrix), [`Autoencoder`]
//! (its updates and steps), [`Adam`], [`Dqn`]; [`Sightings`], [`UNet`], [`NeuralBelief`]. Layers take their
//! variables from a `VarBuilder` of [`variables`], and candle's `backward()` derives all of it. Encoder, recurrence, decoder and U-Net have an
//! operator of ours with a hand-written kernel and gradient (`ops`) beside candle's stock ones, which run on
//! GPUs.
//!
//! To add a layer, make it in `Network::new` and call it in `Network::forward`; `examples/second_gru.rs`
//! does so outside.

mod adam;
mod autoencoder;
mod batch_norm;
mod crop;
mod decoder;
mod device;
mod dqn;
mod dropout;
mod encoder;
mod error;
mod gru;
mod model;
mod neural;
mod observation_matrix;
mod operators;
mod ops;
mod pass;
mod replay;
mod shape;
mod sightings;
mod tensors;
mod unet;
pub mod variables;
mod window;

pub use adam::{Adam, AdamSettings};
pub use autoencoder::{Autoencoder, AutoencoderSettings};
pub use candle_core::Device;
pub use decoder::Decoder;
pub use device::{DeviceError, DeviceKind};
pub use dqn::{Dqn, DqnSettings, DqnShape, SavedDqn, Track, Transition};
pub use dropout::{Dropout, Mask};
pub use encoder::Encoder;
pub use error::{NetworkError, NotFinite};
pub use gru::Gru;
pub use model::Network;
pub use neural::{Lesson, NeuralBelief};
pub use observation_matrix::ObservationMatrix;
pub use operators::Operators;
pub use pass::Pass;
pub use replay::FrameReplay;
pub use shape::NetworkShape;
pub use sightings::Sightings;
pub use tensors::NamedTensor;
pub use unet::UNet;
pub use window::Window;
