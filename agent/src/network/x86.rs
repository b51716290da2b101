//! Arithmetic on [`Lanes`] in the vectors of x86 CPUs: the project's only instructions by name.
//!
//! [`Avx512`] and [`Avx2`] are private and only named below functions that are compiled for their
//! instructions, so whoever computes with them runs on a CPU that has these.

use super::lanes::{Arithmetic, Kernel, Lanes};
use std::arch::x86_64::{
    __m256, __m512, _mm256_add_ps, _mm256_castpd_ps, _mm256_castps_pd, _mm256_fmadd_ps,
    _mm256_permute2f128_ps, _mm256_permute4x64_pd, _mm256_shuffle_ps, _mm256_unpackhi_ps,
    _mm256_unpacklo_ps, _mm512_add_ps, _mm512_fmadd_ps, _mm512_permutex2var_ps, _mm512_setr_epi32,
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
    const SUMS: usize = 24;

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

    #[inline(always)]
    fn interleave(a: Lanes, b: Lanes) -> [Lanes; 2] {
        unsafe {
            let [a, b]: [__m512; 2] = transmute([a, b]);
            let low = _mm512_setr_epi32(0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
            let high =
                _mm512_setr_epi32(8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
            transmute([low, high].map(|from| _mm512_permutex2var_ps(a, from, b)))
        }
    }

    #[inline(always)]
    fn deinterleave(a: Lanes, b: Lanes) -> [Lanes; 2] {
        unsafe {
            let [a, b]: [__m512; 2] = transmute([a, b]);
            let even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
            let odd = _mm512_setr_epi32(1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
            transmute([even, odd].map(|from| _mm512_permutex2var_ps(a, from, b)))
        }
    }
}

#[expect(
    unsafe_code,
    reason = "the CPU has these instructions, see above; lanes are sixteen floats"
)]
impl Arithmetic for Avx2 {
    const SUMS: usize = 4;

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

    #[inline(always)]
    fn interleave(a: Lanes, b: Lanes) -> [Lanes; 2] {
        unsafe {
            let [a, b]: [[__m256; 2]; 2] = transmute([a, b]);
            let half = |half: usize| {
                let even = _mm256_unpacklo_ps(a[half], b[half]);
                let odd = _mm256_unpackhi_ps(a[half], b[half]);
                [
                    _mm256_permute2f128_ps::<0x20>(even, odd),
                    _mm256_permute2f128_ps::<0x31>(even, odd),
                ]
            };
            transmute([half(0), half(1)])
        }
    }

    #[inline(always)]
    fn deinterleave(a: Lanes, b: Lanes) -> [Lanes; 2] {
        unsafe {
            let [a, b]: [[__m256; 2]; 2] = transmute([a, b]);
            // Within halves of a register first: quarters come out as 0, 2, 1, 3.
            let sorted = |mixed: __m256| {
                _mm256_castpd_ps(_mm256_permute4x64_pd::<0b11_01_10_00>(_mm256_castps_pd(
                    mixed,
                )))
            };
            let even = [a, b].map(|x| sorted(_mm256_shuffle_ps::<0b10_00_10_00>(x[0], x[1])));
            let odd = [a, b].map(|x| sorted(_mm256_shuffle_ps::<0b11_01_11_01>(x[0], x[1])));
            transmute([even, odd])
        }
    }
}
