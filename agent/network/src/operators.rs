//! Which operators a network computes with.

use candle_core::{DType, Device};

/// The implementation of the networks' operators. Both give the same results up to rounding.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Operators {
    /// Hand-written kernels and gradients (`ops`), for 32-bit floats on the CPU.
    Own,
    /// Candle's, arranged for a device that is slow to copy from and slow to scatter: losses are sums over all cells with
    /// a weight each, and an update copies few numbers back. For any device and any floats. The recurrence alone
    /// goes through the CPU: a thousand steps of a few numbers are a thousand times a dozen launches.
    Stock,
}

impl Operators {
    /// The fastest that compute there.
    pub fn on(device: &Device, dtype: DType) -> Self {
        if device.is_cpu() && dtype == DType::F32 {
            Self::Own
        } else {
            Self::Stock
        }
    }
}
