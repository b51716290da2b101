//! The autoencoder against the authors' network and against candle's stock layers.

mod dqn;
mod golden;
mod golden_file;
mod neural;
mod properties;
mod stock;
mod synthetic;
