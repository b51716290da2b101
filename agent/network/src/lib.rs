//! The paper's networks as candle models: the dynamic autoencoder (sections III.B and III.C, eqs. 7 to 11) and the DQN
//! (section III.E). The crate also has a neural belief, which minimises the same loss but works on the grid itself
//! instead of on a hidden vector.
//!
//! In reading order: [`Network`] (the model: encoder, GRU, decoder, observation matrix), [`Autoencoder`] (its
//! updates and steps), [`Adam`], [`Dqn`]; [`Sightings`], [`UNet`], [`NeuralBelief`].
//!
//! Layers create their variables through a `VarBuilder` from [`variables`], and candle's `backward()` computes all
//! gradients. Encoder, recurrence, decoder and U-Net each have two implementations: our operators with hand-written
//! kernels and gradients (`ops`), and candle's stock operators, which also run on GPUs.
//!
//! To add a layer, create it in `Network::new` and call it in `Network::forward`.

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
pub use candle_core::{Device, utils::barrier_pool};
pub use device::{DEVICES, open_device};
pub use dqn::{Dqn, DqnSettings, DqnShape, Track, Transition};
pub use dropout::{Dropout, Mask};
pub use error::{NetworkError, NotFinite};
pub use model::Network;
pub use neural::{Lesson, NeuralBelief};
pub use operators::Operators;
pub use pass::Pass;
pub use replay::FrameReplay;
pub use shape::NetworkShape;
pub use sightings::Sightings;
pub use tensors::NamedTensor;
pub use unet::UNet;
pub use window::Window;
