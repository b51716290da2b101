//! The inner loop of a doubling's backward pass: outputs are sums of shifted planes, pixels in lanes.
//!
//! `out[m][p] = sum over inputs k and taps t of weight[k, m][t] * plane[k][offset_t + p]`. A block of outputs
//! stays in registers while all inputs and taps pass.

use super::lanes::{Arithmetic, LANES, Lanes};

/// The 4 x 4 kernel of a pair of channels.
pub(crate) type Kernel4x4 = Lanes;

/// Vectors of pixels per block, where a plane has as many. 4 x 4 sums fit the 32 registers of AVX-512.
const WIDE: usize = 4;

/// One term of each output.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Tap {
    /// Where the shifted plane begins, within the planes of an input channel.
    pub(crate) offset: usize,
    /// Its entry of the kernel.
    pub(crate) entry: usize,
}

/// Inputs, outputs and weights of one frame.
#[derive(Clone, Copy)]
pub(crate) struct Correlation<'a> {
    /// The planes of each input, in the order of `inputs`.
    pub(crate) planes: &'a [f32],
    /// Numbers per input.
    pub(crate) stride: usize,
    /// Channels.
    pub(crate) inputs: &'a [u16],
    /// Channels.
    pub(crate) outputs: &'a [u16],
    pub(crate) weights: &'a [Kernel4x4],
    /// Distance in `weights` between input channels.
    pub(crate) input_step: usize,
    /// Distance in `weights` between output channels.
    pub(crate) output_step: usize,
}

/// Calls `block` with the number of outputs as a constant, so that their sums fit registers.
macro_rules! with_constant {
    ($length:expr, $block:ident, [$($n:literal)*], $vectors:literal, $args:tt) => {
        match $length {
            $($n => with_constant!(@call $block, $n, $vectors, $args),)*
            _ => unreachable!("invariant: blocks are no longer than the list"),
        }
    };
    (@call $block:ident, $n:literal, $vectors:literal, ($self:ident, $($arg:expr),*)) => {
        $self.$block::<A, $n, $vectors>($($arg),*)
    };
}
pub(crate) use with_constant;

impl Correlation<'_> {
    /// Writes `out`: one plane per output, `out_stride` apart, of `length` pixels in whole lanes.
    #[inline(always)]
    pub(crate) fn write<A: Arithmetic, const TAPS: usize>(
        &self,
        taps: &[Tap; TAPS],
        length: usize,
        out: &mut [f32],
        out_stride: usize,
    ) {
        let mut first = 0;
        while first < length {
            let n_vectors = if length - first >= WIDE * LANES {
                WIDE
            } else {
                1
            };
            let most = if n_vectors == WIDE { 4 } else { 12 };
            let mut done = 0;
            for outputs in balanced(self.outputs, most) {
                let out = &mut out[done * out_stride + first..];
                self.write_block::<A, TAPS>(n_vectors, outputs, taps, first, out, out_stride);
                done += outputs.len();
            }
            first += n_vectors * LANES;
        }
    }

    #[inline(always)]
    fn write_block<A: Arithmetic, const TAPS: usize>(
        &self,
        n_vectors: usize,
        outputs: &[u16],
        taps: &[Tap; TAPS],
        first: usize,
        out: &mut [f32],
        stride: usize,
    ) {
        let length = outputs.len();
        if n_vectors == WIDE {
            with_constant!(
                length, block, [1 2 3 4], 4,
                (self, outputs, taps, first, out, stride)
            );
        } else {
            with_constant!(
                length, block, [1 2 3 4 5 6 7 8 9 10 11 12], 1,
                (self, outputs, taps, first, out, stride)
            );
        }
    }

    /// `OUTPUTS` times `VECTORS` sums.
    #[inline(always)]
    fn block<A: Arithmetic, const OUTPUTS: usize, const VECTORS: usize>(
        &self,
        outputs: &[u16],
        taps: &[Tap],
        first: usize,
        out: &mut [f32],
        stride: usize,
    ) {
        let at: [usize; OUTPUTS] =
            std::array::from_fn(|output| usize::from(outputs[output]) * self.output_step);
        let mut sums = [[Lanes::ZERO; VECTORS]; OUTPUTS];
        for (planes, &input) in self.planes.chunks_exact(self.stride).zip(self.inputs) {
            let weights = &self.weights[usize::from(input) * self.input_step..];
            let mut kernels = [&weights[0]; OUTPUTS];
            for (kernel, at) in kernels.iter_mut().zip(at) {
                *kernel = &weights[at];
            }
            for tap in taps {
                let pixels = Lanes::load_all::<VECTORS>(&planes[tap.offset + first..]);
                for output in 0..OUTPUTS {
                    let weight = kernels[output].0[tap.entry % LANES];
                    for vector in 0..VECTORS {
                        sums[output][vector] =
                            sums[output][vector].add_scaled::<A>(weight, pixels[vector]);
                    }
                }
            }
        }
        for (output, sums) in sums.iter().enumerate() {
            for (vector, sum) in sums.iter().enumerate() {
                sum.store(&mut out[output * stride + vector * LANES..]);
            }
        }
    }
}

/// Parts of nearly equal length, none longer than `most`.
#[inline(always)]
pub(crate) fn balanced<T>(items: &[T], most: usize) -> std::slice::Chunks<'_, T> {
    let n_parts = items.len().div_ceil(most).max(1);
    items.chunks(items.len().div_ceil(n_parts).max(1))
}
