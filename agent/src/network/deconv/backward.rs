//! A doubling backward: from gradients of its outputs to those of its inputs and weights.

use super::{Doubling, GRADIENT_PLANES, Scratch, TAPS};
use crate::network::correlation::{Correlation, Kernel4x4, Tap, balanced, with_constant};
use crate::network::lanes::{Arithmetic, Lanes};

impl Doubling {
    /// Puts the gradient of kept output number `index` where [`Self::backward`] expects it: `write`
    /// is given each row's number and place.
    #[inline(always)]
    pub(crate) fn place_gradient(
        &self,
        index: usize,
        scratch: &mut Scratch,
        mut write: impl FnMut(usize, &mut [f32]),
    ) {
        let [rows, cols] = self.input;
        let border = 2 * cols + 2;
        let bordered = &mut scratch.bordered[index * (2 * rows + 2) * border..];
        for (row, bordered) in bordered[border..]
            .chunks_exact_mut(border)
            .enumerate()
            .take(2 * rows)
        {
            write(row, &mut bordered[1..=2 * cols]);
        }
        let length = self.gradient_plane();
        let group = &mut scratch.gradients[index * GRADIENT_PLANES * length..];
        for row in 0..2 * rows + 2 {
            let from = &bordered[row * border..][..border];
            let at = row % 2 * 4 * length + row / 2 * cols;
            for col in [0, 2] {
                let (even, odd) = group[at + col * length..].split_at_mut(length);
                let to = even[..cols].iter_mut().zip(&mut odd[..cols]);
                // Both of a pair at once: LLVM makes shuffles of this, and slow gathers of each alone.
                for ((even, odd), pair) in to.zip(from[col..].as_chunks::<2>().0) {
                    [*even, *odd] = *pair;
                }
            }
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
        let taps: [Tap; TAPS] = std::array::from_fn(|entry| {
            let (row, col) = (entry / 4, entry % 4);
            Tap {
                offset: (row % 2 * 4 + col) * self.gradient_plane() + row / 2 * self.input[1],
                entry,
            }
        });
        scratch.dx[..inputs.len() * self.plane_in()].fill(0.0);
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
        correlation.add_to::<A, TAPS>(&taps, plane, &mut scratch.dx, plane);
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
        for first_row in (0..self.input[0]).step_by(self.band_rows()) {
            let n_rows = self.band_rows().min(self.input[0] - first_row);
            self.gather_patches::<A>(outputs.len(), first_row, n_rows, scratch);
            let band = Band {
                doubling: self,
                patches: &scratch.patches,
                length: n_rows * self.input[1],
                values: &scratch.values[first_row * self.input[1]..],
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

    /// The 4 x 4 gradients that each pixel of some rows reached, and their sum per output.
    #[inline(always)]
    fn gather_patches<A: Arithmetic>(
        &self,
        n_outputs: usize,
        first_row: usize,
        n_rows: usize,
        to: &mut Scratch,
    ) {
        let [rows, cols] = self.input;
        let border = 2 * cols + 2;
        for output in 0..n_outputs {
            let bordered = &to.bordered[output * (2 * rows + 2) * border..];
            let patches = &mut to.patches[output * n_rows * cols * TAPS..][..n_rows * cols * TAPS];
            let mut sum = to.patch_sums[output];
            for (row, patches) in patches.chunks_exact_mut(cols * TAPS).enumerate() {
                let reached = &bordered[(first_row + row) * 2 * border..][..4 * border];
                let reached: [&[f32]; 4] =
                    std::array::from_fn(|row| &reached[row * border..][..border]);
                for (col, patch) in patches.as_chunks_mut::<TAPS>().0.iter_mut().enumerate() {
                    for (entries, row) in patch.as_chunks_mut::<4>().0.iter_mut().zip(reached) {
                        entries.copy_from_slice(&row[2 * col..][..4]);
                    }
                }
            }
            // Not in the loop above: a patch just written in parts is slow to read as a whole.
            for patch in patches.as_chunks().0 {
                sum = sum.add::<A>(Lanes(*patch));
            }
            to.patch_sums[output] = sum;
        }
    }

    /// Adds the part of the weights' gradient that goes through the constants `k`, from the patch sums
    /// of all frames per output channel.
    pub(crate) fn add_constant_gradient(
        &self,
        k: &[f32],
        patch_sums: &[Lanes],
        d_weights: &mut [Kernel4x4],
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
            sum = sum.add_product::<A>(Lanes(weights[usize::from(output)]), *patch_sum);
        }
        sum.sum()
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
        let patches: [&[Kernel4x4]; OUTPUTS] = std::array::from_fn(|index| {
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
                d_weights[at] = sum.add::<A>(Lanes(d_weights[at])).0;
            }
        }
    }
}
