//! A doubling: transposed convolution with a 4 x 4 kernel, stride 2, padding 1, one frame at a time.
//!
//! Output `(2 y + p, 2 x + q)` of phase `(p, q)` depends on 2 x 2 inputs around `(y, x)` through four
//! entries of the kernel, so each phase is an ordinary correlation at the input's size. Only channels
//! that dropout kept are computed: inputs are `x = x' + k`, where `k` is the constant that a lost
//! channel has, so `x'` is zero there and `k` adds [`Doubling::constant_map`], the same for all frames.

use super::batch_norm::Norm;
use super::correlation::{Correlation, Kernel4x4, Tap, balanced, with_constant};
use super::lanes::{Arithmetic, LANES, Lanes, whole_lanes};

/// Columns to the left, none, to the right.
const COLUMN_SHIFTS: usize = 3;
const PHASES: usize = 4;
const TAPS: usize = 16;
/// Planes of an output gradient: of two row parities and four columns of the kernel.
const GRADIENT_PLANES: usize = 8;
/// Pixels whose patches are made at once, to stay in the fastest cache.
const BAND: usize = 64;

/// Sizes and weights of one doubling.
#[derive(Debug)]
pub(crate) struct Doubling {
    /// Rows and columns before doubling.
    pub(crate) input: [usize; 2],
    pub(crate) channels_in: usize,
    pub(crate) channels_out: usize,
    /// `[in][out]`.
    weights: Vec<Kernel4x4>,
}

/// Room for one frame's planes; every plane not written is zero.
#[derive(Debug, Clone)]
pub(crate) struct Scratch {
    /// Per kept input its values, shifted by a column to the right, not, and to the left.
    shifted: Vec<f32>,
    /// Per kept output its four phases.
    phases: Vec<f32>,
    /// Per kept output its gradient, with a border of zeros.
    bordered: Vec<f32>,
    /// All outputs' gradients, as each tap meets them.
    gradients: Vec<f32>,
    /// Per output and pixel of a band the 4 x 4 gradients that the pixel reached.
    patches: Vec<f32>,
    /// Per kept output the sum of its patches.
    pub(crate) patch_sums: Vec<Lanes>,
    /// Per kept input `x'`.
    pub(crate) values: Vec<f32>,
    /// Per kept input its gradient.
    pub(crate) dx: Vec<f32>,
}

impl Doubling {
    /// From PyTorch's `[in][out][4][4]`.
    pub(crate) fn new(input: [usize; 2], channels: [usize; 2], weight: &[f32]) -> Self {
        let [channels_in, channels_out] = channels;
        Self {
            input,
            channels_in,
            channels_out,
            weights: weight.as_chunks().0.to_vec(),
        }
    }

    /// Numbers per input plane: its pixels, padded to whole lanes.
    pub(crate) fn plane_in(&self) -> usize {
        whole_lanes(self.input[0] * self.input[1])
    }

    /// Numbers per output plane.
    pub(crate) fn plane_out(&self) -> usize {
        whole_lanes(4 * self.input[0] * self.input[1])
    }

    /// Of one column shift: a row of zeros above and below, and what the last lanes read beyond.
    fn shifted_plane(&self) -> usize {
        whole_lanes((self.input[0] + 2) * self.input[1] + LANES)
    }

    fn gradient_plane(&self) -> usize {
        whole_lanes((self.input[0] + 1) * self.input[1] + LANES)
    }

    pub(crate) fn scratch(&self) -> Scratch {
        let [rows, cols] = self.input;
        let plane = self.plane_in();
        let band = self.band_rows() * cols;
        Scratch {
            shifted: vec![0.0; self.channels_in * COLUMN_SHIFTS * self.shifted_plane()],
            phases: vec![0.0; self.channels_out * PHASES * plane],
            bordered: vec![0.0; self.channels_out * (2 * rows + 2) * (2 * cols + 2)],
            gradients: vec![0.0; self.channels_out * GRADIENT_PLANES * self.gradient_plane()],
            patches: vec![0.0; self.channels_out * band * TAPS],
            patch_sums: vec![Lanes::ZERO; self.channels_out],
            values: vec![0.0; self.channels_in * plane],
            dx: vec![0.0; self.channels_in * plane],
        }
    }

    fn band_rows(&self) -> usize {
        (BAND / self.input[1]).clamp(1, self.input[0])
    }

    /// The four terms of a phase.
    fn phase_taps(&self, [row_phase, col_phase]: [usize; 2]) -> [Tap; 4] {
        // Output 2 y + p meets inputs y + p - 1 and y + p, through entries 3 - p and 1 - p.
        std::array::from_fn(|term| {
            let (row, col) = (row_phase + term / 2, col_phase + term % 2);
            Tap {
                offset: col * self.shifted_plane() + row * self.input[1],
                entry: (3 - row_phase - term / 2 * 2) * 4 + 3 - col_phase - term % 2 * 2,
            }
        })
    }

    /// What inputs that are `k` everywhere add to each output: its phases, in planes as of `phases`.
    pub(crate) fn constant_map(&self, k: &[f32]) -> Vec<f32> {
        let [rows, cols] = self.input;
        let plane = self.plane_in();
        let mut constants = vec![0.0; self.channels_out * PHASES * plane];
        for (output, phases) in constants.chunks_exact_mut(PHASES * plane).enumerate() {
            let entry_sum = |entry: usize| -> f32 {
                let inputs = k.iter().enumerate();
                inputs
                    .map(|(input, k)| k * self.weights[input * self.channels_out + output][entry])
                    .sum()
            };
            let sums: [f32; TAPS] = std::array::from_fn(entry_sum);
            for (phase, phases) in phases.chunks_exact_mut(plane).enumerate() {
                for (pixel, value) in phases[..rows * cols].iter_mut().enumerate() {
                    let at = [pixel / cols, pixel % cols];
                    *value = self.constant_at([phase / 2, phase % 2], at, &sums);
                }
            }
        }
        constants
    }

    /// One pixel of [`Self::constant_map`]: the entries that meet an input on the grid.
    fn constant_at(&self, phase: [usize; 2], at: [usize; 2], sums: &[f32; TAPS]) -> f32 {
        let mut total = 0.0;
        for term in 0..4 {
            let terms = [term / 2, term % 2];
            let inside = |axis: usize| {
                let input = at[axis] + phase[axis] + terms[axis];
                (1..=self.input[axis]).contains(&input)
            };
            if inside(0) && inside(1) {
                let [row, col] = [0, 1].map(|axis| 3 - phase[axis] - 2 * terms[axis]);
                total += sums[row * 4 + col];
            }
        }
        total
    }

    /// `x' = relu(scale u + shift) - k` of the kept inputs, one plane each.
    #[inline(always)]
    pub(crate) fn values<A: Arithmetic>(
        &self,
        u: &[f32],
        kept: &[u16],
        norm: &Norm,
        k: &[f32],
        values: &mut [f32],
    ) {
        let (plane, pixels) = (self.plane_in(), self.input[0] * self.input[1]);
        let planes = values.chunks_exact_mut(plane).zip(u.chunks_exact(plane));
        for ((values, u), &channel) in planes.zip(kept) {
            let channel = usize::from(channel);
            let (scale, shift, k) = (norm.scale[channel], norm.shift[channel], k[channel]);
            for (value, u) in values[..pixels].iter_mut().zip(u) {
                *value = A::mul_add(*u, scale, shift).max(0.0) - k;
            }
        }
    }

    /// The kept outputs of one frame, one plane each, from `x'` in `scratch.values`; `constants` is
    /// [`Self::constant_map`] and `factor` multiplies every output.
    #[inline(always)]
    pub(crate) fn forward<A: Arithmetic>(
        &self,
        kept: [&[u16]; 2],
        constants: &[f32],
        factor: f32,
        scratch: &mut Scratch,
        out: &mut [f32],
    ) {
        let [inputs, outputs] = kept;
        self.shift_columns(inputs.len(), &scratch.values, &mut scratch.shifted);
        let group = PHASES * self.plane_in();
        for (phases, &output) in scratch.phases.chunks_exact_mut(group).zip(outputs) {
            phases.copy_from_slice(&constants[usize::from(output) * group..][..group]);
        }
        let stride = COLUMN_SHIFTS * self.shifted_plane();
        let correlation = Correlation {
            planes: &scratch.shifted[..inputs.len() * stride],
            stride,
            inputs,
            outputs,
            weights: &self.weights,
            input_step: self.channels_out,
            output_step: 1,
        };
        for phase in 0..PHASES {
            let taps = self.phase_taps([phase / 2, phase % 2]);
            let out = &mut scratch.phases[phase * self.plane_in()..];
            correlation.add_to::<A, 4>(&taps, self.plane_in(), out, group);
        }
        for (phases, out) in scratch
            .phases
            .chunks_exact(group)
            .zip(out.chunks_exact_mut(self.plane_out()))
            .take(outputs.len())
        {
            self.weave(phases, factor, out);
        }
    }

    /// Writes each kept input's plane three times: shifted right, as it is, shifted left.
    #[inline(always)]
    fn shift_columns(&self, n_inputs: usize, values: &[f32], shifted: &mut [f32]) {
        let [rows, cols] = self.input;
        let (plane, length) = (self.plane_in(), self.shifted_plane());
        let groups = shifted.chunks_exact_mut(COLUMN_SHIFTS * length);
        for (group, values) in groups.zip(values.chunks_exact(plane)).take(n_inputs) {
            let (right, rest) = group.split_at_mut(length);
            let (same, left) = rest.split_at_mut(length);
            let values = &values[..rows * cols];
            same[cols..][..values.len()].copy_from_slice(values);
            right[cols + 1..][..values.len()].copy_from_slice(values);
            left[cols..][..values.len() - 1].copy_from_slice(&values[1..]);
            // What a shift took from the row before or after is off the grid.
            for row in 1..=rows {
                right[row * cols] = 0.0;
                left[row * cols + cols - 1] = 0.0;
            }
            right[(rows + 1) * cols] = 0.0;
        }
    }

    /// Joins one output's phases to rows.
    #[inline(always)]
    fn weave(&self, phases: &[f32], factor: f32, out: &mut [f32]) {
        let [rows, cols] = self.input;
        let plane = self.plane_in();
        let out_rows = out[..4 * rows * cols].chunks_exact_mut(2 * cols);
        for (out_row, to) in out_rows.enumerate() {
            let first = out_row % 2 * 2 * plane + out_row / 2 * cols;
            let (even, odd) = (&phases[first..][..cols], &phases[first + plane..][..cols]);
            for (to, (even, odd)) in to
                .as_chunks_mut::<2>()
                .0
                .iter_mut()
                .zip(even.iter().zip(odd))
            {
                *to = [even * factor, odd * factor];
            }
        }
    }

    /// Puts the gradient of kept output number `index` where [`Self::backward`] expects it; `dz` has
    /// one number per pixel.
    #[inline(always)]
    pub(crate) fn place_gradient(&self, index: usize, dz: &[f32], scratch: &mut Scratch) {
        let [rows, cols] = self.input;
        let border = 2 * cols + 2;
        let bordered = &mut scratch.bordered[index * (2 * rows + 2) * border..];
        for (row, dz) in dz[..4 * rows * cols].chunks_exact(2 * cols).enumerate() {
            bordered[(row + 1) * border + 1..][..2 * cols].copy_from_slice(dz);
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
            let patches: [Lanes; OUTPUTS] =
                std::array::from_fn(|index| Lanes(patches[index][pixel]));
            for input in 0..INPUTS {
                for output in 0..OUTPUTS {
                    let sum = &mut sums[input][output];
                    *sum = sum.add_scaled::<A>(values[input][pixel], patches[output]);
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
