//! Sixteen numbers at once, on the widest vectors that the processor has.
//!
//! Work is generic over [`Lanes`], inlined from end to end, and compiled once per kind of vector:
//! AVX-512, AVX2, or plain arrays, which is also what checks in `f64` use. (Left to LLVM alone, the
//! loops of arrays took ten times as long.) Results may differ in the last bits between kinds of
//! processors, never between runs or numbers of threads on one.

use ndarray::NdFloat;

/// Cells computed at once: one AVX-512 register of `f32`.
pub(super) const LANES: usize = 16;

/// A number that recursions are computed in: `f32`, or `f64` for checks.
pub trait Real: NdFloat + Wide {}

impl Real for f32 {}
impl Real for f64 {}

/// The vectors of a number.
pub trait Wide: Sized {
    /// With AVX-512.
    type Avx512: Lanes<Self>;
    /// With AVX2 and fused multiply-add.
    type Avx2: Lanes<Self>;
}

/// `LANES` numbers.
pub trait Lanes<T>: Copy {
    /// The same number in each lane.
    fn splat(number: T) -> Self;
    fn load(numbers: &[T; LANES]) -> Self;
    fn store(self, numbers: &mut [T; LANES]);
    /// `self * factor + term`.
    fn multiply_add(self, factor: Self, term: Self) -> Self;
    /// `self + other`.
    fn plus(self, other: Self) -> Self;
    /// `self - other`.
    fn minus(self, other: Self) -> Self;
    /// `self * other`.
    fn times(self, other: Self) -> Self;
    /// `self / other`.
    fn over(self, other: Self) -> Self;
}

/// A piece of work; implementations of `run` are `#[inline(always)]`, down to the innermost loop. Loads and sums in
/// closures, as those of `array::from_fn`, are not always inlined: write loops.
pub(super) trait Vectorised {
    /// What it computes in.
    type Number: Real;
    /// What it gives.
    type Output;

    fn run<V: Lanes<Self::Number>>(self) -> Self::Output;
}

/// Runs on the widest vectors that the processor has.
pub(super) fn on_widest<W: Vectorised>(work: W) -> W::Output {
    #[cfg(target_arch = "x86_64")]
    {
        let fused = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
        if fused && is_x86_feature_detected!("avx512f") {
            #[expect(unsafe_code, reason = "sound on a CPU with AVX-512, as this one is")]
            return unsafe { on_avx512(work) };
        }
        if fused {
            #[expect(unsafe_code, reason = "sound on a CPU with AVX2, as this one is")]
            return unsafe { on_avx2(work) };
        }
    }
    work.run::<Plain<W::Number>>()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx2,fma")]
fn on_avx512<W: Vectorised>(work: W) -> W::Output {
    work.run::<<W::Number as Wide>::Avx512>()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn on_avx2<W: Vectorised>(work: W) -> W::Output {
    work.run::<<W::Number as Wide>::Avx2>()
}

/// Lanes as LLVM sees fit.
#[derive(Debug, Clone, Copy)]
pub struct Plain<T>([T; LANES]);

impl<T: NdFloat> Lanes<T> for Plain<T> {
    #[inline(always)]
    fn splat(number: T) -> Self {
        Self([number; LANES])
    }

    #[inline(always)]
    fn load(numbers: &[T; LANES]) -> Self {
        Self(*numbers)
    }

    #[inline(always)]
    fn store(self, numbers: &mut [T; LANES]) {
        *numbers = self.0;
    }

    #[inline(always)]
    fn multiply_add(self, factor: Self, term: Self) -> Self {
        self.times(factor).plus(term)
    }

    #[inline(always)]
    fn plus(self, other: Self) -> Self {
        self.pairwise(other, |a, b| a + b)
    }

    #[inline(always)]
    fn minus(self, other: Self) -> Self {
        self.pairwise(other, |a, b| a - b)
    }

    #[inline(always)]
    fn times(self, other: Self) -> Self {
        self.pairwise(other, |a, b| a * b)
    }

    #[inline(always)]
    fn over(self, other: Self) -> Self {
        self.pairwise(other, |a, b| a / b)
    }
}

impl<T: NdFloat> Plain<T> {
    #[inline(always)]
    fn pairwise(mut self, other: Self, f: impl Fn(T, T) -> T) -> Self {
        for lane in 0..LANES {
            self.0[lane] = f(self.0[lane], other.0[lane]);
        }
        self
    }
}

impl Wide for f64 {
    type Avx512 = Plain<Self>;
    type Avx2 = Plain<Self>;
}

#[cfg(not(target_arch = "x86_64"))]
impl Wide for f32 {
    type Avx512 = Plain<Self>;
    type Avx2 = Plain<Self>;
}

#[cfg(target_arch = "x86_64")]
impl Wide for f32 {
    type Avx512 = x86::Avx512;
    type Avx2 = x86::Avx2;
}

/// Registers of x86-64. Their values only come to be in `on_avx512` and `on_avx2`, which only run
/// where the processor has the instructions.
#[cfg(target_arch = "x86_64")]
#[expect(unsafe_code, reason = "each instruction is there where these run")]
mod x86 {
    use crate::learning::filter::vector::{LANES, Lanes};
    use std::arch::x86_64::*;

    /// One register of 16.
    #[derive(Debug, Clone, Copy)]
    pub struct Avx512(__m512);

    /// Two registers of 8.
    #[derive(Debug, Clone, Copy)]
    pub struct Avx2(__m256, __m256);

    impl Lanes<f32> for Avx512 {
        #[inline(always)]
        fn splat(number: f32) -> Self {
            Self(unsafe { _mm512_set1_ps(number) })
        }

        #[inline(always)]
        fn load(numbers: &[f32; LANES]) -> Self {
            Self(unsafe { _mm512_loadu_ps(numbers.as_ptr()) })
        }

        #[inline(always)]
        fn store(self, numbers: &mut [f32; LANES]) {
            unsafe { _mm512_storeu_ps(numbers.as_mut_ptr(), self.0) }
        }

        #[inline(always)]
        fn multiply_add(self, factor: Self, term: Self) -> Self {
            Self(unsafe { _mm512_fmadd_ps(self.0, factor.0, term.0) })
        }

        #[inline(always)]
        fn plus(self, other: Self) -> Self {
            Self(unsafe { _mm512_add_ps(self.0, other.0) })
        }

        #[inline(always)]
        fn minus(self, other: Self) -> Self {
            Self(unsafe { _mm512_sub_ps(self.0, other.0) })
        }

        #[inline(always)]
        fn times(self, other: Self) -> Self {
            Self(unsafe { _mm512_mul_ps(self.0, other.0) })
        }

        #[inline(always)]
        fn over(self, other: Self) -> Self {
            Self(unsafe { _mm512_div_ps(self.0, other.0) })
        }
    }

    impl Lanes<f32> for Avx2 {
        #[inline(always)]
        fn splat(number: f32) -> Self {
            let half = unsafe { _mm256_set1_ps(number) };
            Self(half, half)
        }

        #[inline(always)]
        fn load(numbers: &[f32; LANES]) -> Self {
            let (low, high) = numbers.split_at(LANES / 2);
            unsafe {
                Self(
                    _mm256_loadu_ps(low.as_ptr()),
                    _mm256_loadu_ps(high.as_ptr()),
                )
            }
        }

        #[inline(always)]
        fn store(self, numbers: &mut [f32; LANES]) {
            let (low, high) = numbers.split_at_mut(LANES / 2);
            unsafe {
                _mm256_storeu_ps(low.as_mut_ptr(), self.0);
                _mm256_storeu_ps(high.as_mut_ptr(), self.1);
            }
        }

        #[inline(always)]
        fn multiply_add(self, factor: Self, term: Self) -> Self {
            unsafe {
                Self(
                    _mm256_fmadd_ps(self.0, factor.0, term.0),
                    _mm256_fmadd_ps(self.1, factor.1, term.1),
                )
            }
        }

        #[inline(always)]
        fn plus(self, other: Self) -> Self {
            unsafe {
                Self(
                    _mm256_add_ps(self.0, other.0),
                    _mm256_add_ps(self.1, other.1),
                )
            }
        }

        #[inline(always)]
        fn minus(self, other: Self) -> Self {
            unsafe {
                Self(
                    _mm256_sub_ps(self.0, other.0),
                    _mm256_sub_ps(self.1, other.1),
                )
            }
        }

        #[inline(always)]
        fn times(self, other: Self) -> Self {
            unsafe {
                Self(
                    _mm256_mul_ps(self.0, other.0),
                    _mm256_mul_ps(self.1, other.1),
                )
            }
        }

        #[inline(always)]
        fn over(self, other: Self) -> Self {
            unsafe {
                Self(
                    _mm256_div_ps(self.0, other.0),
                    _mm256_div_ps(self.1, other.1),
                )
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Arithmetic([f32; LANES], [f32; LANES]);

    impl Vectorised for Arithmetic {
        type Number = f32;
        type Output = [f32; LANES];

        #[inline(always)]
        fn run<V: Lanes<f32>>(self) -> [f32; LANES] {
            let (a, b) = (V::load(&self.0), V::load(&self.1));
            let mut out = [0.0; LANES];
            let sum = a.multiply_add(b, V::splat(1.5)).plus(a).minus(b);
            sum.times(b).over(a).store(&mut out);
            out
        }
    }

    #[test]
    fn every_kind_of_vector_computes_the_same() {
        let a: [f32; LANES] = std::array::from_fn(|lane| 1.0 + lane as f32 * 0.25);
        let b: [f32; LANES] = std::array::from_fn(|lane| 3.0 - lane as f32 * 0.5);
        // Small multiples of 1/16 are exact: only the division rounds.
        let expected: [f32; LANES] =
            std::array::from_fn(|i| (a[i] * b[i] + 1.5 + a[i] - b[i]) * b[i] / a[i]);
        assert_eq!(Arithmetic(a, b).run::<Plain<f32>>(), expected);
        assert_eq!(on_widest(Arithmetic(a, b)), expected);
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            #[expect(unsafe_code, reason = "sound on a CPU with AVX2, as this one is")]
            let got = unsafe { on_avx2(Arithmetic(a, b)) };
            assert_eq!(got, expected);
        }
    }
}
