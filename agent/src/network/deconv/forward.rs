//! A doubling forward: four phases at once, each a correlation of shifted planes.

use super::{Around, COLUMN_SHIFTS, Doubling, PHASES, SIDE, Scratch, TAPS};
use crate::network::batch_norm::Norm;
use crate::network::correlation::{Kernel4x4, balanced, with_constant};
use crate::network::lanes::{Arithmetic, Buffer, LANES, Lanes};

/// Output channels that are computed at once, at most.
const MOST_OUTPUTS: usize = 6;

impl Doubling {
    /// What inputs that are `k` everywhere add to each output.
    pub(crate) fn constant_map(&self, k: &[f32]) -> Buffer {
        let output = self.output();
        let [rows, cols] = output.size();
        let mut constants = Buffer::zeros(self.channels_out * output.length());
        let maps = constants.chunks_exact_mut(output.length());
        for (channel, constants) in maps.enumerate() {
            let entry_sum = |entry: usize| -> f32 {
                let inputs = k.iter().enumerate();
                inputs
                    .map(|(input, k)| {
                        k * self.weights[input * self.channels_out + channel].0[entry]
                    })
                    .sum()
            };
            let sums: [f32; TAPS] = std::array::from_fn(entry_sum);
            for row in 0..rows {
                for col in 0..cols {
                    constants[output.at(row, col)] = self.constant_at([row, col], &sums);
                }
            }
        }
        constants
    }

    /// One pixel of [`Self::constant_map`]: the entries that meet an input on the grid.
    fn constant_at(&self, at: [usize; 2], sums: &[f32; TAPS]) -> f32 {
        let mut total = 0.0;
        for term in 0..4 {
            let terms = [term / 2, term % 2];
            let inside = |axis: usize| {
                let input = at[axis] / 2 + at[axis] % 2 + terms[axis];
                (1..=self.input.size()[axis]).contains(&input)
            };
            if inside(0) && inside(1) {
                let [row, col] = [0, 1].map(|axis| 3 - at[axis] % 2 - 2 * terms[axis]);
                total += sums[row * 4 + col];
            }
        }
        total
    }

    /// `x' = relu(scale u + shift) - k` of the kept inputs, row by row, one plane each.
    #[inline(always)]
    pub(crate) fn values<A: Arithmetic>(
        &self,
        u: &[f32],
        kept: &[u16],
        norm: &Norm,
        k: &[f32],
        scratch: &mut Scratch,
    ) {
        let Scratch { values, map, .. } = scratch;
        let planes = values.chunks_exact_mut(self.plane_in());
        let inputs = planes.zip(u.chunks_exact(self.input.length()));
        for ((values, u), &channel) in inputs.zip(kept) {
            let channel = usize::from(channel);
            let (scale, shift, k) = (norm.scale[channel], norm.shift[channel], k[channel]);
            for (value, u) in map.iter_mut().zip(u) {
                *value = A::mul_add(*u, scale, shift).max(0.0) - k;
            }
            self.input.to_rows::<A>(map, values);
        }
    }

    /// The kept outputs of one frame from `x'` in `scratch.values`; `constants` is
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
        let length = self.output().length();
        for first in (0..self.plane_in()).step_by(LANES) {
            let Scratch {
                shifted, around, ..
            } = &mut *scratch;
            self.look_around(first, shifted, &mut around[..inputs.len()]);
            let pass = Forward {
                doubling: self,
                inputs,
                around,
                constants,
                factor,
                first,
            };
            let mut done = 0;
            for outputs in balanced(outputs, (A::SUMS / PHASES).min(MOST_OUTPUTS)) {
                let out = &mut out[done * length..][..outputs.len() * length];
                with_constant!(outputs.len(), block, [1 2 3 4 5 6], 4, (pass, outputs, out));
                done += outputs.len();
            }
        }
        for out in out.chunks_exact_mut(length).take(outputs.len()) {
            self.output().clear_padding(out);
        }
    }

    /// Writes each kept input's plane three times: shifted right, as it is, shifted left.
    #[inline(always)]
    fn shift_columns(&self, n_inputs: usize, values: &[f32], shifted: &mut [f32]) {
        let [rows, cols] = self.input.size();
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

    /// The 3 x 3 neighbours of sixteen pixels, of each input.
    #[inline(always)]
    fn look_around(&self, first: usize, shifted: &[f32], around: &mut [Around]) {
        let (length, cols) = (self.shifted_plane(), self.input.size()[1]);
        let inputs = shifted.chunks_exact(COLUMN_SHIFTS * length);
        for (planes, around) in inputs.zip(around) {
            for (col, plane) in planes.chunks_exact(length).enumerate() {
                for row in 0..SIDE {
                    around[row * SIDE + col] = Lanes::load(&plane[row * cols + first..]);
                }
            }
        }
    }
}

/// Sixteen pixels' way through a doubling.
#[derive(Clone, Copy)]
struct Forward<'a> {
    doubling: &'a Doubling,
    inputs: &'a [u16],
    /// Of each input, in the order of `inputs`.
    around: &'a [Around],
    constants: &'a [f32],
    factor: f32,
    /// Number of the first pixel.
    first: usize,
}

impl Forward<'_> {
    /// All phases of `OUTPUTS` channels. The sums stay in registers while all inputs pass.
    #[inline(always)]
    fn block<A: Arithmetic, const OUTPUTS: usize, const PHASES: usize>(
        &self,
        outputs: &[u16],
        out: &mut [f32],
    ) {
        let doubling = self.doubling;
        let (plane, length) = (doubling.plane_in(), doubling.output().length());
        let mut channels = [0; OUTPUTS];
        for (channel, &output) in channels.iter_mut().zip(outputs) {
            *channel = usize::from(output);
        }
        let mut sums = [[Lanes::ZERO; OUTPUTS]; PHASES];
        for (phase, sums) in sums.iter_mut().enumerate() {
            for (sum, channel) in sums.iter_mut().zip(channels) {
                let at = channel * length + phase * plane + self.first;
                *sum = Lanes::load(&self.constants[at..]);
            }
        }
        for (around, &input) in self.around.iter().zip(self.inputs) {
            let weights = &doubling.weights[usize::from(input) * doubling.channels_out..];
            let weights = &weights[..doubling.channels_out];
            let mut kernels = [&weights[0]; OUTPUTS];
            for (kernel, channel) in kernels.iter_mut().zip(channels) {
                *kernel = &weights[channel];
            }
            add_phase::<A, OUTPUTS, 0>(around, kernels, &mut sums[0]);
            add_phase::<A, OUTPUTS, 1>(around, kernels, &mut sums[1]);
            add_phase::<A, OUTPUTS, 2>(around, kernels, &mut sums[2]);
            add_phase::<A, OUTPUTS, 3>(around, kernels, &mut sums[3]);
        }
        for (phase, sums) in sums.iter().enumerate() {
            for (sum, out) in sums.iter().zip(out.chunks_exact_mut(length)) {
                let out = &mut out[phase * plane + self.first..];
                Lanes::ZERO.add_scaled::<A>(self.factor, *sum).store(out);
            }
        }
    }
}

/// Adds one input's four terms of a phase: output `2 y + p` meets `y + p - 1` and `y + p`, which are numbers
/// `p` and `p + 1` around `y`, through entries `3 - p` and `1 - p`.
#[inline(always)]
fn add_phase<A: Arithmetic, const OUTPUTS: usize, const PHASE: usize>(
    around: &Around,
    kernels: [&Kernel4x4; OUTPUTS],
    sums: &mut [Lanes; OUTPUTS],
) {
    let (row, col) = (PHASE / 2, PHASE % 2);
    for term in 0..4 {
        let (down, right) = (term / 2, term % 2);
        let pixels = around[(row + down) * SIDE + col + right];
        let entry = (3 - row - 2 * down) * 4 + 3 - col - 2 * right;
        for output in 0..OUTPUTS {
            sums[output] = sums[output].add_scaled::<A>(kernels[output].0[entry], pixels);
        }
    }
}
