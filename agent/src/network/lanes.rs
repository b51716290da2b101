//! Sixteen numbers at once, on the widest vectors that the CPU has.
//!
//! [`dispatch`] compiles a kernel once for AVX-512, once for AVX2 and once for any CPU. Everything
//! between [`Kernel::run`] and [`Lanes`] is `#[inline(always)]`, to be compiled for those vectors.
//! Sums, products and shuffles of [`Lanes`] are named instructions (`x86.rs`): LLVM finds vectors in plain loops
//! over slices, but not reliably in blocks of many sums.

use std::array::from_fn;
use std::ops::{Deref, DerefMut};

/// Numbers in [`Lanes`]: those of one AVX-512 register.
pub(crate) const LANES: usize = 16;

/// How sums and products are computed.
pub(crate) trait Arithmetic: Copy {
    /// How many [`Lanes`] of sums the registers hold, with room for what is added.
    const SUMS: usize;

    /// `a * b + c`.
    fn mul_add(a: f32, b: f32, c: f32) -> f32;

    /// `sum + a * b`, lane by lane.
    fn add_product(sum: Lanes, a: Lanes, b: Lanes) -> Lanes;

    /// `sum + factor * x`.
    #[inline(always)]
    fn add_scaled(sum: Lanes, factor: f32, x: Lanes) -> Lanes {
        Self::add_product(sum, Lanes([factor; LANES]), x)
    }

    /// `a + b`.
    fn add(a: Lanes, b: Lanes) -> Lanes;

    /// `a[0], b[0], a[1], b[1] ..`, all 32.
    fn interleave(a: Lanes, b: Lanes) -> [Lanes; 2];

    /// Of 32 numbers those at even and those at odd places.
    fn deinterleave(a: Lanes, b: Lanes) -> [Lanes; 2];
}

/// On any CPU. Rounds products and sums: without hardware for it, `f32::mul_add` is a slow call.
#[derive(Clone, Copy)]
pub(crate) struct Portable;

impl Arithmetic for Portable {
    const SUMS: usize = 4;

    #[inline(always)]
    fn mul_add(a: f32, b: f32, c: f32) -> f32 {
        a * b + c
    }

    #[inline(always)]
    fn add_product(sum: Lanes, a: Lanes, b: Lanes) -> Lanes {
        Lanes(from_fn(|lane| a.0[lane] * b.0[lane] + sum.0[lane]))
    }

    #[inline(always)]
    fn add(a: Lanes, b: Lanes) -> Lanes {
        Lanes(from_fn(|lane| a.0[lane] + b.0[lane]))
    }

    #[inline(always)]
    fn interleave(a: Lanes, b: Lanes) -> [Lanes; 2] {
        let half = |first: usize| from_fn(|lane| [a, b][lane % 2].0[first + lane / 2]);
        [Lanes(half(0)), Lanes(half(LANES / 2))]
    }

    #[inline(always)]
    fn deinterleave(a: Lanes, b: Lanes) -> [Lanes; 2] {
        let half =
            |first: usize| from_fn(|lane| [a, b][2 * lane / LANES].0[(2 * lane + first) % LANES]);
        [Lanes(half(0)), Lanes(half(1))]
    }
}

/// Work to be compiled for each set of instructions.
pub(crate) trait Kernel {
    /// Does the work.
    fn run<A: Arithmetic>(self);
}

/// Sets of instructions, the widest vectors last.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[cfg_attr(not(target_arch = "x86_64"), expect(dead_code))]
pub(crate) enum Width {
    Portable,
    Avx2,
    Avx512,
}

impl Width {
    /// The widest that this CPU has.
    pub(crate) fn widest() -> Self {
        #[cfg(target_arch = "x86_64")]
        {
            let fused = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
            if fused && is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512vl")
            {
                return Self::Avx512;
            }
            if fused {
                return Self::Avx2;
            }
        }
        Self::Portable
    }
}

/// Runs a kernel with the best instructions of this CPU.
pub(crate) fn dispatch(kernel: impl Kernel) {
    let width = Width::widest();
    #[cfg(test)]
    let width = width.min(tests::LIMIT.get());
    match width {
        #[cfg(target_arch = "x86_64")]
        #[expect(unsafe_code, reason = "sound with AVX-512, which this CPU has")]
        Width::Avx512 => unsafe { super::x86::run_with_avx512(kernel) },
        #[cfg(target_arch = "x86_64")]
        #[expect(unsafe_code, reason = "sound with AVX2 and FMA, which this CPU has")]
        Width::Avx2 => unsafe { super::x86::run_with_avx2(kernel) },
        _ => kernel.run::<Portable>(),
    }
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

    /// The first `N` times sixteen numbers of a slice.
    ///
    /// A loop, as calls of `std::array::from_fn` are not always compiled into their caller, and then copy
    /// arrays that should stay in registers.
    #[inline(always)]
    pub(crate) fn load_all<const N: usize>(from: &[f32]) -> [Self; N] {
        let from = &from[..N * LANES];
        let mut lanes = [Self::ZERO; N];
        for (at, lanes) in lanes.iter_mut().enumerate() {
            *lanes = Self::load(&from[at * LANES..]);
        }
        lanes
    }

    /// Overwrites the first sixteen numbers of a slice.
    #[inline(always)]
    pub(crate) fn store(self, to: &mut [f32]) {
        *to.first_chunk_mut().expect("invariant: whole lanes") = self.0;
    }

    /// `self + factor * x`.
    #[inline(always)]
    pub(crate) fn add_scaled<A: Arithmetic>(self, factor: f32, x: Self) -> Self {
        A::add_scaled(self, factor, x)
    }

    /// `self + a * b`, lane by lane.
    #[inline(always)]
    pub(crate) fn add_product<A: Arithmetic>(self, a: Self, b: Self) -> Self {
        A::add_product(self, a, b)
    }

    #[inline(always)]
    pub(crate) fn add<A: Arithmetic>(self, other: Self) -> Self {
        A::add(self, other)
    }

    /// Rows to columns: lane `j` of number `i` to lane `i` of number `j`.
    #[inline(always)]
    pub(crate) fn transpose<A: Arithmetic>(mut square: [Self; LANES]) -> [Self; LANES] {
        // Each time, the bits of a number's place `16 i + j` rotate by one; four times, `i` and `j` change places.
        for _ in 0..LANES.ilog2() {
            let mut shuffled = square;
            for at in 0..LANES / 2 {
                let pair = A::interleave(square[at], square[at + LANES / 2]);
                [shuffled[2 * at], shuffled[2 * at + 1]] = pair;
            }
            square = shuffled;
        }
        square
    }

    /// The sum over the lanes, pairwise.
    #[inline(always)]
    pub(crate) fn sum(self) -> f32 {
        let eight: [f32; 8] = from_fn(|lane| self.0[lane] + self.0[lane + 8]);
        let four: [f32; 4] = from_fn(|lane| eight[lane] + eight[lane + 4]);
        (four[0] + four[2]) + (four[1] + four[3])
    }
}

/// Numbers that begin where a cache line does: loads and stores of [`Lanes`] meet one line, not two.
#[derive(Debug)]
pub(crate) struct Buffer {
    room: Vec<f32>,
    first: usize,
    length: usize,
}

impl Buffer {
    pub(crate) fn zeros(length: usize) -> Self {
        let room = vec![0.0; length + LANES];
        let first = room.as_ptr().align_offset(align_of::<Lanes>()).min(LANES);
        Self {
            room,
            first,
            length,
        }
    }
}

impl From<&[f32]> for Buffer {
    fn from(numbers: &[f32]) -> Self {
        let mut buffer = Self::zeros(numbers.len());
        buffer.copy_from_slice(numbers);
        buffer
    }
}

impl Clone for Buffer {
    fn clone(&self) -> Self {
        Self::from(&**self)
    }
}

impl Deref for Buffer {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        &self.room[self.first..][..self.length]
    }
}

impl DerefMut for Buffer {
    fn deref_mut(&mut self) -> &mut [f32] {
        &mut self.room[self.first..][..self.length]
    }
}

/// The sums of `x` and of `x * y` over two slices of equal length.
#[inline(always)]
pub(crate) fn sum_and_product<A: Arithmetic>(x: &[f32], y: &[f32]) -> (f32, f32) {
    let (mut sum, mut product) = (Lanes::ZERO, Lanes::ZERO);
    let ((x_lanes, x_rest), (y_lanes, y_rest)) = (x.as_chunks(), y.as_chunks());
    for (x, y) in x_lanes.iter().zip(y_lanes) {
        sum = sum.add::<A>(Lanes(*x));
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
pub(crate) mod tests {
    use super::*;
    use std::cell::Cell;

    thread_local! {
        /// The widest vectors that kernels of this thread may use.
        pub(crate) static LIMIT: Cell<Width> = const { Cell::new(Width::Avx512) };
    }

    /// Runs something on two threads whose kernels use no wider vectors.
    pub(crate) fn at_width<T: Send>(width: Width, work: impl FnOnce() -> T + Send) -> T {
        let threads = rayon::ThreadPoolBuilder::new()
            .num_threads(2)
            .start_handler(move |_| LIMIT.set(width))
            .build();
        threads.expect("threads").install(work)
    }

    /// What every kind of arithmetic must give, up to the rounding of the product.
    struct Check;

    impl Kernel for Check {
        #[inline(always)]
        fn run<A: Arithmetic>(self) {
            let [a, b, c] =
                [1.5, -2.25, 0.125].map(|first| Lanes(from_fn(|lane| first + lane as f32)));
            for lane in 0..LANES {
                let [a_lane, b_lane, c_lane] = [a, b, c].map(|lanes| lanes.0[lane]);
                assert_eq!(c.add_product::<A>(a, b).0[lane], a_lane * b_lane + c_lane);
                assert_eq!(c.add_scaled::<A>(3.0, b).0[lane], 3.0 * b_lane + c_lane);
                assert_eq!(a.add::<A>(b).0[lane], a_lane + b_lane);
                let woven = A::interleave(a, b).map(|lanes| lanes.0);
                assert_eq!(woven.as_flattened()[2 * lane..][..2], [a_lane, b_lane]);
                let [even, odd] = A::deinterleave(Lanes(woven[0]), Lanes(woven[1]));
                assert_eq!([even.0[lane], odd.0[lane]], [a_lane, b_lane]);
            }
            let square = from_fn(|row| Lanes(from_fn(|lane| (row * LANES + lane) as f32)));
            let columns = Lanes::transpose::<A>(square);
            for (lane, column) in columns.iter().enumerate() {
                assert_eq!(column.0, square.map(|row| row.0[lane]));
            }
        }
    }

    #[test]
    fn every_arithmetic_is_that_of_single_numbers() {
        for width in [Width::Portable, Width::Avx2, Width::Avx512] {
            at_width(width, || dispatch(Check));
        }
    }

    #[test]
    fn sums_and_products_are_those_of_plain_loops() {
        for length in [0, 1, 15, 16, 17, 100] {
            let x: Vec<f32> = (0..length).map(|i| i as f32).collect();
            let y: Vec<f32> = (0..length).map(|i| (i % 3) as f32).collect();
            let expected = (x.iter().sum(), x.iter().zip(&y).map(|(x, y)| x * y).sum());
            assert_eq!(sum_and_product::<Portable>(&x, &y), expected, "{length}");
        }
    }
}
