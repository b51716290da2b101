//! A doubling backward: from gradients of its outputs to those of its inputs and weights.

use super::{Doubling, GRADIENT_PLANES, Scratch, TAPS};
use crate::network::correlation::{Correlation, Kernel4x4, Tap, balanced, with_constant};
use crate::network::lanes::{Arithmetic, LANES, Lanes};
use std::ops::Range;

impl Doubling {
    /// Puts the gradient of kept output number `index` where [`Self::backward`] expects it: `write` is given
    /// where each phase's pixels begin in the output's map, and their place.
    #[inline(always)]
    pub(crate) fn place_gradient(
        &self,
        index: usize,
        scratch: &mut Scratch,
        mut write: impl FnMut(usize, &mut [f32]),
    ) {
        let ([_, cols], pixels) = (self.input.size(), self.input.pixels());
        let length = self.gradient_plane();
        let planes = &mut scratch.gradients[index * GRADIENT_PLANES * length..];
        let mut rows = planes[..GRADIENT_PLANES * length].chunks_exact_mut(4 * length);
        // Planes of the kernel's even rows begin with a row off the grid, those of its odd rows end so.
        for (parity, first) in [(1, cols), (0, 0)] {
            let planes = rows.next().expect("invariant: two halves");
            let mut columns = planes.chunks_exact_mut(length);
            let mut column =
                || &mut columns.next().expect("invariant: four columns")[first..][..pixels];
            // A phase meets two columns of the kernel: one as it is, one with its neighbour's pixels.
            let [right, even, odd, left] = [column(), column(), column(), column()];
            write(2 * parity * self.plane_in(), even);
            write((2 * parity + 1) * self.plane_in(), odd);
            right[1..].copy_from_slice(&odd[..pixels - 1]);
            left[..pixels - 1].copy_from_slice(&even[1..]);
            for (right, left) in right
                .chunks_exact_mut(cols)
                .zip(left.chunks_exact_mut(cols))
            {
                (right[0], left[cols - 1]) = (0.0, 0.0);
            }
        }
    }

    /// Where a kernel's entry meets the gradients, for the first pixel.
    #[inline(always)]
    fn tap(&self, entry: usize) -> Tap {
        let (row, col) = (entry / 4, entry % 4);
        let plane = (row % 2 * 4 + col) * self.gradient_plane();
        Tap {
            offset: plane + row / 2 * self.input.size()[1],
            entry,
        }
    }

    /// The gradient of `x` (in `scratch.dx`) and of the weights (added to `d_weights`) from the placed
    /// gradients of the kept outputs; needs `x'` in `scratch.values`.
    ///
    /// Of the weights it adds what goes through `x'`; [`Self::add_constant_gradient`] adds the rest.
    #[inline(always)]
    pub(crate) fn backward<A: Arithmetic>(
        &self,
        kept: [&[u16]; 2],
        scratch: &mut Scratch,
        d_weights: &mut [Kernel4x4],
    ) {
        let [inputs, outputs] = kept;
        let stride = GRADIENT_PLANES * self.gradient_plane();
        let taps: [Tap; TAPS] = std::array::from_fn(|entry| self.tap(entry));
        let correlation = Correlation {
            planes: &scratch.gradients[..outputs.len() * stride],
            stride,
            inputs: outputs,
            outputs: inputs,
            weights: &self.weights,
            input_step: 1,
            output_step: self.channels_out,
        };
        let plane = self.plane_in();
        correlation.write::<A, TAPS>(&taps, plane, &mut scratch.dx, plane);
        self.weight_gradient::<A>(kept, scratch, d_weights);
    }

    #[inline(always)]
    fn weight_gradient<A: Arithmetic>(
        &self,
        kept: [&[u16]; 2],
        scratch: &mut Scratch,
        d_weights: &mut [Kernel4x4],
    ) {
        let [inputs, outputs] = kept;
        scratch.patch_sums[..outputs.len()].fill(Lanes::ZERO);
        let [rows, cols] = self.input.size();
        for first_row in (0..rows).step_by(self.band_rows()) {
            let pixels = first_row * cols..rows.min(first_row + self.band_rows()) * cols;
            self.gather_patches::<A>(outputs.len(), pixels.clone(), scratch);
            let band = Band {
                doubling: self,
                patches: &scratch.patches,
                length: pixels.len(),
                values: &scratch.values[pixels.start..],
            };
            let mut input = 0;
            for inputs in balanced(inputs, 4) {
                let mut output = 0;
                for outputs in balanced(outputs, 4) {
                    band.add::<A>([input, output], [inputs, outputs], d_weights);
                    output += outputs.len();
                }
                input += inputs.len();
            }
        }
    }

    /// The 4 x 4 gradients that each of some pixels reached, and their sum per output.
    #[inline(always)]
    fn gather_patches<A: Arithmetic>(
        &self,
        n_outputs: usize,
        pixels: Range<usize>,
        to: &mut Scratch,
    ) {
        let planes = to
            .gradients
            .chunks_exact(GRADIENT_PLANES * self.gradient_plane());
        let patches = to.patches.chunks_exact_mut(pixels.len() * TAPS);
        let outputs = planes.zip(patches).zip(&mut to.patch_sums);
        for ((planes, patches), sum) in outputs.take(n_outputs) {
            let patches = patches.as_chunks_mut::<TAPS>().0;
            let mut columns = [planes; TAPS];
            for (entry, column) in columns.iter_mut().enumerate() {
                let first = self.tap(entry).offset + pixels.start;
                *column = &planes[first..][..pixels.len()];
            }
            transpose::<A>(columns, patches);
            for patch in patches {
                *sum = sum.add::<A>(Lanes(*patch));
            }
        }
    }

    /// Adds the part of the weights' gradient that goes through the constants `k`, from the patch sums
    /// of all frames per output channel.
    pub(crate) fn add_constant_gradient(
        &self,
        k: &[f32],
        patch_sums: &[Lanes],
        d_weights: &mut [[f32; TAPS]],
    ) {
        for (k, d_weights) in k.iter().zip(d_weights.chunks_exact_mut(self.channels_out)) {
            for (d_kernel, sum) in d_weights.iter_mut().zip(patch_sums) {
                for (d, sum) in d_kernel.iter_mut().zip(sum.0) {
                    *d += k * sum;
                }
            }
        }
    }

    /// The gradient of a channel that dropout took, summed over one frame's pixels.
    #[inline(always)]
    pub(crate) fn lost_gradient<A: Arithmetic>(
        &self,
        channel: u16,
        outputs: &[u16],
        patch_sums: &[Lanes],
    ) -> f32 {
        let weights =
            &self.weights[usize::from(channel) * self.channels_out..][..self.channels_out];
        let mut sum = Lanes::ZERO;
        for (&output, patch_sum) in outputs.iter().zip(patch_sums) {
            sum = sum.add_product::<A>(weights[usize::from(output)], *patch_sum);
        }
        sum.sum()
    }
}

/// Writes columns side by side.
#[inline(always)]
fn transpose<A: Arithmetic>(columns: [&[f32]; TAPS], patches: &mut [[f32; TAPS]]) {
    let (squares, rest) = patches.as_chunks_mut::<LANES>();
    for (index, square) in squares.iter_mut().enumerate() {
        let mut lanes = [Lanes::ZERO; TAPS];
        for (lanes, column) in lanes.iter_mut().zip(columns) {
            *lanes = Lanes::load(&column[index * LANES..]);
        }
        for (patch, lanes) in square.iter_mut().zip(Lanes::transpose::<A>(lanes)) {
            *patch = lanes.0;
        }
    }
    for (pixel, patch) in (squares.len() * LANES..).zip(rest) {
        for (entry, column) in patch.iter_mut().zip(columns) {
            *entry = column[pixel];
        }
    }
}

/// Some rows of one frame, to sum weight gradients over.
#[derive(Clone, Copy)]
struct Band<'a> {
    doubling: &'a Doubling,
    patches: &'a [f32],
    /// Pixels.
    length: usize,
    values: &'a [f32],
}

impl Band<'_> {
    #[inline(always)]
    fn add<A: Arithmetic>(
        &self,
        first: [usize; 2],
        channels: [&[u16]; 2],
        d_weights: &mut [Kernel4x4],
    ) {
        let length = channels[0].len();
        macro_rules! of_outputs {
            ($n:literal) => {
                with_constant!(length, block, [1 2 3 4], $n, (self, first, channels, d_weights))
            };
        }
        match channels[1].len() {
            4 => of_outputs!(4),
            3 => of_outputs!(3),
            2 => of_outputs!(2),
            _ => of_outputs!(1),
        }
    }

    /// `d_weights[input][output] += sum over pixels of x'[input] patch[output]`.
    #[inline(always)]
    fn block<A: Arithmetic, const INPUTS: usize, const OUTPUTS: usize>(
        &self,
        [input, output]: [usize; 2],
        [inputs, outputs]: [&[u16]; 2],
        d_weights: &mut [Kernel4x4],
    ) {
        let plane = self.doubling.plane_in();
        let values: [&[f32]; INPUTS] =
            std::array::from_fn(|index| &self.values[(input + index) * plane..][..self.length]);
        let patches: [&[[f32; TAPS]]; OUTPUTS] = std::array::from_fn(|index| {
            let first = (output + index) * self.length * TAPS;
            self.patches[first..][..self.length * TAPS].as_chunks().0
        });
        let mut sums = [[Lanes::ZERO; OUTPUTS]; INPUTS];
        for pixel in 0..self.length {
            for output in 0..OUTPUTS {
                let patch = Lanes(patches[output][pixel]);
                for input in 0..INPUTS {
                    let sum = &mut sums[input][output];
                    *sum = sum.add_scaled::<A>(values[input][pixel], patch);
                }
            }
        }
        for (sums, &input) in sums.iter().zip(inputs) {
            for (sum, &output) in sums.iter().zip(outputs) {
                let at = usize::from(input) * self.doubling.channels_out + usize::from(output);
                d_weights[at] = sum.add::<A>(d_weights[at]);
            }
        }
    }
}
