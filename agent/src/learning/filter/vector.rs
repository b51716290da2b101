//! Several numbers at once, on the vectors that the processor has: pulp's, for both kinds of floats.
//!
//! (Left to LLVM alone, loops over arrays took ten times as long.) Results may differ in the last bits between
//! kinds of processors, never between runs or numbers of threads on one.

use bytemuck::{Pod, bytes_of, cast_slice, cast_slice_mut, pod_read_unaligned};
use ndarray::NdFloat;
use pulp::Simd;

/// Numbers in the widest vector that there is; layouts have room for whole ones.
pub(super) const LANES: usize = 16;

/// A number that recursions are computed in: `f32`, or `f64` for checks.
pub trait Real: NdFloat + Pod {
    type Vector<S: Simd>: Pod;

    /// The same number in each lane.
    fn splat<S: Simd>(simd: S, number: Self) -> Self::Vector<S>;

    /// `a b + c`.
    fn multiply_add<S: Simd>(
        simd: S,
        a: Self::Vector<S>,
        b: Self::Vector<S>,
        c: Self::Vector<S>,
    ) -> Self::Vector<S>;

    fn plus<S: Simd>(simd: S, a: Self::Vector<S>, b: Self::Vector<S>) -> Self::Vector<S>;
    fn minus<S: Simd>(simd: S, a: Self::Vector<S>, b: Self::Vector<S>) -> Self::Vector<S>;
    fn times<S: Simd>(simd: S, a: Self::Vector<S>, b: Self::Vector<S>) -> Self::Vector<S>;
    fn over<S: Simd>(simd: S, a: Self::Vector<S>, b: Self::Vector<S>) -> Self::Vector<S>;
}

macro_rules! real {
    ($number:ty, $vector:ident, $splat:ident, $multiply_add:ident,
     $($name:ident = $operation:ident),*) => {
        impl Real for $number {
            type Vector<S: Simd> = S::$vector;

            #[inline(always)]
            fn splat<S: Simd>(simd: S, number: Self) -> S::$vector {
                simd.$splat(number)
            }

            #[inline(always)]
            fn multiply_add<S: Simd>(
                simd: S,
                a: S::$vector,
                b: S::$vector,
                c: S::$vector,
            ) -> S::$vector {
                simd.$multiply_add(a, b, c)
            }

            $(#[inline(always)]
            fn $name<S: Simd>(simd: S, a: S::$vector, b: S::$vector) -> S::$vector {
                simd.$operation(a, b)
            })*
        }
    };
}

real!(
    f32,
    f32s,
    splat_f32s,
    mul_add_f32s,
    plus = add_f32s,
    minus = sub_f32s,
    times = mul_f32s,
    over = div_f32s
);
real!(
    f64,
    f64s,
    splat_f64s,
    mul_add_f64s,
    plus = add_f64s,
    minus = sub_f64s,
    times = mul_f64s,
    over = div_f64s
);

/// Numbers in a vector.
#[inline(always)]
pub(super) const fn lanes<T: Real, S: Simd>() -> usize {
    size_of::<T::Vector<S>>() / size_of::<T>()
}

#[inline(always)]
pub(super) fn load<T: Real, S: Simd>(numbers: &[T], at: usize) -> T::Vector<S> {
    pod_read_unaligned(cast_slice(&numbers[at..at + lanes::<T, S>()]))
}

#[inline(always)]
pub(super) fn store<T: Real, S: Simd>(vector: T::Vector<S>, numbers: &mut [T], at: usize) {
    let numbers = &mut numbers[at..at + lanes::<T, S>()];
    cast_slice_mut(numbers).copy_from_slice(bytes_of(&vector));
}

/// The sum of the lanes.
#[inline(always)]
pub(super) fn total<T: Real, S: Simd>(vector: T::Vector<S>) -> f64 {
    let lanes: &[T] = cast_slice(bytes_of(&vector));
    let lanes = lanes.iter();
    lanes
        .map(|lane| lane.to_f64().expect("invariant: floats cast"))
        .sum()
}
