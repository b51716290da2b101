//! The choice between our operators and candle's.

use candle_core::{DType, Device};

/// The implementation of the networks' operators. Both implementations compute the same results, up to rounding.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Operators {
    /// Hand-written kernels and gradients (`ops`), for 32-bit floats on the CPU.
    Own,
    /// Candle's operators, for any device and any floats.
    ///
    /// They suit devices on which copies to the host and scatter operations are slow: losses are weighted sums over all
    /// cells, and an update copies only a few numbers to the host. Only the recurrence runs on the CPU, because on a
    /// GPU each of its thousand small steps would take a dozen kernel launches.
    Stock,
}

impl Operators {
    /// Returns the fastest operators for a device and a number type.
    pub fn on(device: &Device, dtype: DType) -> Self {
        if device.is_cpu() && dtype == DType::F32 {
            Self::Own
        } else {
            Self::Stock
        }
    }
}
