//! Arithmetic on [`Lanes`] in the vectors of x86 CPUs: the project's only instructions by name.
//!
//! [`Avx512`] and [`Avx2`] are private and only named below functions that are compiled for their
//! instructions, so whoever computes with them runs on a CPU that has these.

use super::lanes::{Arithmetic, Kernel, Lanes};
use std::arch::x86_64::{
    __m256, __m512, _mm256_add_ps, _mm256_fmadd_ps, _mm512_add_ps, _mm512_fmadd_ps,
};
use std::mem::transmute;

/// [`Kernel::run`], compiled for AVX-512.
#[target_feature(enable = "avx512f,avx512vl,avx2,fma")]
pub(crate) fn run_with_avx512(kernel: impl Kernel) {
    kernel.run::<Avx512>();
}

/// [`Kernel::run`], compiled for AVX2 and FMA.
#[target_feature(enable = "avx2,fma")]
pub(crate) fn run_with_avx2(kernel: impl Kernel) {
    kernel.run::<Avx2>();
}

/// Lanes are one register.
#[derive(Clone, Copy)]
struct Avx512;

/// Lanes are two registers.
#[derive(Clone, Copy)]
struct Avx2;

#[expect(
    unsafe_code,
    reason = "the CPU has these instructions, see above; lanes are sixteen floats"
)]
impl Arithmetic for Avx512 {
    #[inline(always)]
    fn mul_add(a: f32, b: f32, c: f32) -> f32 {
        a.mul_add(b, c)
    }

    #[inline(always)]
    fn add_product(sum: Lanes, a: Lanes, b: Lanes) -> Lanes {
        unsafe {
            let [sum, a, b]: [__m512; 3] = transmute([sum, a, b]);
            transmute(_mm512_fmadd_ps(a, b, sum))
        }
    }

    #[inline(always)]
    fn add(a: Lanes, b: Lanes) -> Lanes {
        unsafe {
            let [a, b]: [__m512; 2] = transmute([a, b]);
            transmute(_mm512_add_ps(a, b))
        }
    }
}

#[expect(
    unsafe_code,
    reason = "the CPU has these instructions, see above; lanes are sixteen floats"
)]
impl Arithmetic for Avx2 {
    #[inline(always)]
    fn mul_add(a: f32, b: f32, c: f32) -> f32 {
        a.mul_add(b, c)
    }

    #[inline(always)]
    fn add_product(sum: Lanes, a: Lanes, b: Lanes) -> Lanes {
        unsafe {
            let [sum, a, b]: [[__m256; 2]; 3] = transmute([sum, a, b]);
            let half = |half: usize| _mm256_fmadd_ps(a[half], b[half], sum[half]);
            transmute([half(0), half(1)])
        }
    }

    #[inline(always)]
    fn add(a: Lanes, b: Lanes) -> Lanes {
        unsafe {
            let [a, b]: [[__m256; 2]; 2] = transmute([a, b]);
            transmute([_mm256_add_ps(a[0], b[0]), _mm256_add_ps(a[1], b[1])])
        }
    }
}
