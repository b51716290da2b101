//! Work that is compiled once per width of the processor's vectors, and run on the widest.
//!
//! Plain loops over arrays of [`LANES`] numbers, inlined so that LLVM compiles them for their
//! caller's vectors. Results may differ in the last bits between processors with and without fused
//! multiply-add, never between runs or numbers of threads on one.

use ndarray::NdFloat;

/// Cells computed at once: one AVX-512 register of `f32`.
pub(super) const LANES: usize = 16;

/// A piece of work; implementations of `run` are `#[inline(always)]`, down to the innermost loop.
pub(super) trait Vectorised {
    /// What it gives.
    type Output;

    /// Does the work; `FUSED`: with fused multiply-add.
    fn run<const FUSED: bool>(self) -> Self::Output;
}

/// Runs on the widest vectors that the processor has.
pub(super) fn on_widest<W: Vectorised>(work: W) -> W::Output {
    #[cfg(target_arch = "x86_64")]
    {
        let fused = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
        if fused && is_x86_feature_detected!("avx512f") {
            #[expect(
                unsafe_code,
                reason = "sound on a CPU with AVX-512, which this one has"
            )]
            return unsafe { on_avx512(work) };
        }
        if fused {
            #[expect(unsafe_code, reason = "sound on a CPU with AVX2, which this one has")]
            return unsafe { on_avx2(work) };
        }
    }
    work.run::<false>()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx2,fma")]
fn on_avx512<W: Vectorised>(work: W) -> W::Output {
    work.run::<true>()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn on_avx2<W: Vectorised>(work: W) -> W::Output {
    work.run::<true>()
}

/// `a * b + c`.
#[inline(always)]
pub(super) fn multiply_add<T: NdFloat, const FUSED: bool>(a: T, b: T, c: T) -> T {
    if FUSED { a.mul_add(b, c) } else { a * b + c }
}
