//! A doubling forward: four phases, each a correlation of shifted planes, woven to rows.

use super::{COLUMN_SHIFTS, Doubling, PHASES, Scratch, TAPS};
use crate::network::batch_norm::Norm;
use crate::network::correlation::{Correlation, Tap};
use crate::network::lanes::Arithmetic;

impl Doubling {
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
}
