//! Tests of the networks, against the authors' network and candle's stock layers.

mod dqn;
mod golden;
mod golden_file;
mod neural;
mod properties;
mod stock;
mod synthetic;
