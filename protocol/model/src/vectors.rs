//! Loops compiled for the vectors that a processor has.

use pulp::{Arch, Simd, WithSimd};

/// Number of cells computed at once: four AVX2 registers of `f32`. Independent sums hide the latency of additions.
pub const LANES: usize = 32;

/// Does `work`, compiled for AVX-512, AVX2 and plain vectors. No operation is fused, so the results are the same.
///
/// Only what is inlined is compiled so: write `#[inline(always)]` before the closure and the functions that it calls.
#[inline(always)]
pub fn vectorised<R>(work: impl FnMut() -> R) -> R {
    Arch::new().dispatch(Work(work))
}

struct Work<F>(F);

// By reference, as a closure called by value is not always inlined.
impl<R, F: FnMut() -> R> WithSimd for Work<F> {
    type Output = R;

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, _: S) -> R {
        (self.0)()
    }
}
