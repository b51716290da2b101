//! Compiles loops for the vector instructions of the processor.

use pulp::{Arch, Simd, WithSimd};

/// Number of cells computed at once: four AVX2 registers of `f32`. Independent sums hide the latency of additions.
pub const LANES: usize = 32;

/// One number for each of [`LANES`] cells.
pub type Lanes = [f32; LANES];

/// Runs `work`, compiled for AVX-512, AVX2 or plain vectors, depending on what the processor supports. No operation is
/// fused, so all variants return the same results.
///
/// Only inlined code is compiled this way: write `#[inline(always)]` before the closure and the functions that it
/// calls.
#[inline(always)]
pub fn vectorised<R>(work: impl FnMut() -> R) -> R {
    Arch::new().dispatch(Work(work))
}

struct Work<F>(F);

// Called by reference, because a closure called by value is not always inlined.
impl<R, F: FnMut() -> R> WithSimd for Work<F> {
    type Output = R;

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, _: S) -> R {
        (self.0)()
    }
}
