//! The autoencoder against the authors' network and against candle's stock layers.

mod golden;
