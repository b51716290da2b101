//! Sixteen numbers at once, on the widest vectors that the CPU has.
//!
//! Plain loops over arrays: LLVM compiles them for the vectors of the function that they are inlined
//! into. [`dispatch`] is that function, once for AVX-512, once for AVX2 and once for any CPU. So
//! everything between [`Kernel::run`] and [`Lanes`] is `#[inline(always)]`.
//!
//! That takes optimisation level 3: at level 2, rustc leaves LLVM's superword vectoriser off, and kernels
//! are 60 times as slow.

/// Numbers in [`Lanes`]: those of one AVX-512 register.
pub(crate) const LANES: usize = 16;

/// How `a * b + c` is rounded: once where the CPU can, else twice.
pub(crate) trait Arithmetic: Copy {
    /// `a * b + c`.
    fn mul_add(a: f32, b: f32, c: f32) -> f32;
}

/// Rounds once.
#[derive(Clone, Copy)]
struct Fused;

/// Rounds the product, then the sum: without hardware for it, `f32::mul_add` is a slow library call.
#[derive(Clone, Copy)]
struct Separate;

impl Arithmetic for Fused {
    #[inline(always)]
    fn mul_add(a: f32, b: f32, c: f32) -> f32 {
        a.mul_add(b, c)
    }
}

impl Arithmetic for Separate {
    #[inline(always)]
    fn mul_add(a: f32, b: f32, c: f32) -> f32 {
        a * b + c
    }
}

/// Work to be compiled for each set of instructions.
pub(crate) trait Kernel {
    /// Does the work.
    fn run<A: Arithmetic>(self);
}

/// Runs a kernel with the best instructions of this CPU.
pub(crate) fn dispatch(kernel: impl Kernel) {
    #[cfg(target_arch = "x86_64")]
    {
        let fused = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
        if fused && is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512vl") {
            #[expect(unsafe_code, reason = "sound with AVX-512, which this CPU has")]
            unsafe {
                run_with_avx512(kernel);
            }
            return;
        }
        if fused {
            #[expect(unsafe_code, reason = "sound with AVX2 and FMA, which this CPU has")]
            unsafe {
                run_with_avx2(kernel);
            }
            return;
        }
    }
    kernel.run::<Separate>();
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512vl,avx2,fma")]
fn run_with_avx512(kernel: impl Kernel) {
    kernel.run::<Fused>();
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn run_with_avx2(kernel: impl Kernel) {
    kernel.run::<Fused>();
}

/// Sixteen numbers.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
pub(crate) struct Lanes(pub(crate) [f32; LANES]);

impl Lanes {
    pub(crate) const ZERO: Self = Self([0.0; LANES]);

    /// The first sixteen numbers of a slice.
    #[inline(always)]
    pub(crate) fn load(from: &[f32]) -> Self {
        Self(*from.first_chunk().expect("invariant: whole lanes"))
    }

    /// Overwrites the first sixteen numbers of a slice.
    #[inline(always)]
    pub(crate) fn store(self, to: &mut [f32]) {
        *to.first_chunk_mut().expect("invariant: whole lanes") = self.0;
    }

    /// `self + factor * x`.
    #[inline(always)]
    pub(crate) fn add_scaled<A: Arithmetic>(self, factor: f32, x: Self) -> Self {
        let mut sum = self.0;
        for lane in 0..LANES {
            sum[lane] = A::mul_add(factor, x.0[lane], sum[lane]);
        }
        Self(sum)
    }

    /// `self + a * b`, lane by lane.
    #[inline(always)]
    pub(crate) fn add_product<A: Arithmetic>(self, a: Self, b: Self) -> Self {
        let mut sum = self.0;
        for lane in 0..LANES {
            sum[lane] = A::mul_add(a.0[lane], b.0[lane], sum[lane]);
        }
        Self(sum)
    }

    #[inline(always)]
    pub(crate) fn add(self, other: Self) -> Self {
        let mut sum = self.0;
        for lane in 0..LANES {
            sum[lane] += other.0[lane];
        }
        Self(sum)
    }

    /// The sum over the lanes, pairwise.
    #[inline(always)]
    pub(crate) fn sum(self) -> f32 {
        let mut sums = self.0;
        for half in [8, 4, 2, 1] {
            for lane in 0..half {
                sums[lane] += sums[lane + half];
            }
        }
        sums[0]
    }
}

/// The sums of `x` and of `x * y` over two slices of equal length.
#[inline(always)]
pub(crate) fn sum_and_product<A: Arithmetic>(x: &[f32], y: &[f32]) -> (f32, f32) {
    let (mut sum, mut product) = (Lanes::ZERO, Lanes::ZERO);
    let ((x_lanes, x_rest), (y_lanes, y_rest)) = (x.as_chunks(), y.as_chunks());
    for (x, y) in x_lanes.iter().zip(y_lanes) {
        sum = sum.add(Lanes(*x));
        product = product.add_product::<A>(Lanes(*x), Lanes(*y));
    }
    let (mut sum, mut product) = (sum.sum(), product.sum());
    for (x, y) in x_rest.iter().zip(y_rest) {
        sum += x;
        product = A::mul_add(*x, *y, product);
    }
    (sum, product)
}

/// The next multiple of [`LANES`].
pub(crate) const fn whole_lanes(length: usize) -> usize {
    length.next_multiple_of(LANES)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_and_products_are_those_of_plain_loops() {
        for length in [0, 1, 15, 16, 17, 100] {
            let x: Vec<f32> = (0..length).map(|i| i as f32).collect();
            let y: Vec<f32> = (0..length).map(|i| (i % 3) as f32).collect();
            let expected = (x.iter().sum(), x.iter().zip(&y).map(|(x, y)| x * y).sum());
            assert_eq!(sum_and_product::<Separate>(&x, &y), expected, "{length}");
            assert_eq!(sum_and_product::<Fused>(&x, &y), expected, "{length}");
        }
    }
}
