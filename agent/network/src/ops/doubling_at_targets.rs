//! The decoder's last doubling, at the cells that are to be predicted only.

use super::cpu::{add_scaled, dot, frames, numbers, slice, tensor, total};
use super::norm::{Moments, Norm, Sums, finish};
use super::taps::{Sizes, TAPS, meeting};
use crate::dropout::Mask;
use crate::window::Window;
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor};
use rayon::prelude::*;

/// Arguments as of [`super::doubling::Doubling`]; the result is `[targets, channels out]`.
pub(crate) struct DoublingAtTargets {
    /// Dropout of `z`.
    pub(crate) input: Mask,
    /// Of `z` after its dropout.
    pub(crate) moments: Moments,
    pub(crate) window: Window,
}

/// What meets at a target: its number in the frame, the input's cell, the tap.
type Meeting = (usize, usize, usize);

/// One call: what all frames share.
struct Call<'a> {
    op: &'a DoublingAtTargets,
    sizes: Sizes,
    norm: Norm,
    z: &'a [f32],
    /// `[taps, channels out, channels in]`.
    kernels: Vec<f32>,
}

/// One chunk's sums in the backward pass.
struct Gradients {
    kernels: Vec<f32>,
    sums: Sums,
}

/// The numbers of one input cell, by channel.
struct Column {
    /// `a` where the channel is kept, else 0: `y = a z + b`.
    a: Vec<f32>,
    keeps: Vec<f32>,
    z: Vec<f32>,
    /// `relu(y)`.
    x: Vec<f32>,
    /// 1 where `y` is positive, else 0.
    slope: Vec<f32>,
}

impl<'a> Call<'a> {
    fn new(
        op: &'a DoublingAtTargets,
        sizes: Sizes,
        z: &'a [f32],
        weights: &[f32],
        kernels: &[f32],
    ) -> Self {
        Self {
            op,
            sizes,
            norm: Norm::new(weights, &op.moments, op.input.scale()),
            z,
            kernels: by_tap(kernels, sizes.channels_in),
        }
    }

    #[inline(always)]
    fn for_each_meeting(&self, frame: usize, mut f: impl FnMut(Meeting)) {
        for (target, visit) in self.op.window.targets(frame).iter().enumerate() {
            for (tap_row, row) in meeting(usize::from(visit.row), self.sizes.rows) {
                for (tap_col, col) in meeting(usize::from(visit.col), self.sizes.cols) {
                    f((target, row * self.sizes.cols + col, tap_row * 4 + tap_col));
                }
            }
        }
    }

    fn column(&self, frame: usize) -> Column {
        let scales = self.op.input.scales(frame);
        let keeps: Vec<f32> = scales.iter().map(|s| f32::from(*s != 0.0)).collect();
        let zeros = vec![0.0; keeps.len()];
        Column {
            a: self.norm.a.iter().zip(&keeps).map(|(a, k)| a * k).collect(),
            keeps,
            z: zeros.clone(),
            x: zeros.clone(),
            slope: zeros,
        }
    }

    fn frame_of_z(&self, frame: usize) -> &[f32] {
        &self.z[frame * self.sizes.per_input()..][..self.sizes.per_input()]
    }

    #[inline(always)]
    fn read(&self, z: &[f32], cell: usize, column: &mut Column) {
        let planes = z[cell..].iter().step_by(self.sizes.area());
        column.z.iter_mut().zip(planes).for_each(|(to, z)| *to = *z);
        for channel in 0..column.z.len() {
            let y = column.a[channel] * column.z[channel] + self.norm.b[channel];
            column.x[channel] = y.max(0.0);
            column.slope[channel] = f32::from(y > 0.0);
        }
    }

    fn forward(&self, frame: usize) -> Vec<f32> {
        let (n_in, n_out) = (self.sizes.channels_in, self.sizes.channels_out);
        let (z, mut column) = (self.frame_of_z(frame), self.column(frame));
        let mut out = vec![0.0; self.op.window.targets(frame).len() * n_out];
        self.for_each_meeting(frame, |(target, cell, tap)| {
            self.read(z, cell, &mut column);
            let kernels = self.kernels[tap * n_out * n_in..].chunks_exact(n_in);
            for (out, kernel) in out[target * n_out..][..n_out].iter_mut().zip(kernels) {
                *out += dot(&column.x, kernel);
            }
        });
        out
    }

    fn all_frames(&self) -> Vec<f32> {
        let frames = (0..self.op.window.len()).into_par_iter();
        let outputs = frames.map(|frame| pulp::Arch::new().dispatch(|| self.forward(frame)));
        outputs.collect::<Vec<_>>().concat()
    }

    /// Gradients of `z`, of `[gamma; beta]` and of the kernels.
    fn gradients(&self, d_out: &[f32]) -> [Vec<f32>; 3] {
        let mut dz = vec![0.0; self.z.len()];
        let new = || Gradients {
            kernels: vec![0.0; self.kernels.len()],
            sums: Sums::new(self.sizes.channels_in),
        };
        let chunks = frames(&mut dz, self.sizes.per_input(), new, |chunk, frame, dz| {
            let first = self.op.window.target_start(frame) * self.sizes.channels_out;
            self.gradients_of_frame(chunk, frame, &d_out[first..], dz);
        });
        let (kernels, sums): (Vec<_>, Vec<_>) = chunks
            .into_iter()
            .map(|chunk| (chunk.kernels, chunk.sums))
            .unzip();
        let d_kernels = from_taps(&total(kernels), self.sizes.channels_in);
        let (d_weights, terms) = self.norm.backward(&Sums::total(sums));
        finish(&terms, self.z, &mut dz, &self.op.input);
        [dz, d_weights, d_kernels]
    }

    /// Leaves the gradients behind the normalisation in `dz`.
    #[inline(always)]
    fn gradients_of_frame(
        &self,
        chunk: &mut Gradients,
        frame: usize,
        d_out: &[f32],
        dz: &mut [f32],
    ) {
        let (n_in, n_out) = (self.sizes.channels_in, self.sizes.channels_out);
        let (z, mut column) = (self.frame_of_z(frame), self.column(frame));
        let mut dx = vec![0.0; n_in];
        let mut sums = [vec![0.0_f32; n_in], vec![0.0; n_in], vec![0.0; n_in]];
        let [kept, with_z, lost] = &mut sums;
        self.for_each_meeting(frame, |(target, cell, tap)| {
            self.read(z, cell, &mut column);
            dx.fill(0.0);
            let taps = tap * n_out * n_in..(tap + 1) * n_out * n_in;
            let kernels = self.kernels[taps.clone()].chunks_exact(n_in);
            let rows = kernels.zip(chunk.kernels[taps].chunks_exact_mut(n_in));
            for (d_out, (kernel, d_kernel)) in d_out[target * n_out..].iter().zip(rows) {
                add_scaled(&mut dx, *d_out, kernel);
                add_scaled(d_kernel, *d_out, &column.x);
            }
            for channel in 0..n_in {
                let all = dx[channel] * column.slope[channel];
                let d = all * column.keeps[channel];
                dz[channel * self.sizes.area() + cell] += d;
                kept[channel] += d;
                with_z[channel] += d * column.z[channel];
                lost[channel] += all - d;
            }
        });
        for channel in 0..n_in {
            chunk.sums.first[channel] += f64::from(kept[channel]);
            chunk.sums.with_z[channel] += f64::from(with_z[channel]);
            chunk.sums.lost[channel] += f64::from(lost[channel]);
        }
    }
}

/// Kernels `[channels in, channels out, taps]` as `[taps, channels out, channels in]`.
fn by_tap(kernels: &[f32], channels: usize) -> Vec<f32> {
    let n_out = kernels.len() / channels / TAPS;
    let from = |to: usize| {
        let (tap, output, channel) = (to / channels / n_out, to / channels % n_out, to % channels);
        kernels[(channel * n_out + output) * TAPS + tap]
    };
    (0..kernels.len()).map(from).collect()
}

/// The other way.
fn from_taps(by_tap: &[f32], channels: usize) -> Vec<f32> {
    let n_out = by_tap.len() / channels / TAPS;
    let from = |to: usize| {
        let (channel, output, tap) = (to / TAPS / n_out, to / TAPS % n_out, to % TAPS);
        by_tap[(tap * n_out + output) * channels + channel]
    };
    (0..by_tap.len()).map(from).collect()
}

impl CustomOp3 for DoublingAtTargets {
    fn name(&self) -> &'static str {
        "doubling-at-targets"
    }

    fn cpu_fwd(
        &self,
        z: &CpuStorage,
        z_layout: &Layout,
        weights: &CpuStorage,
        weights_layout: &Layout,
        kernels: &CpuStorage,
        kernels_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let sizes = Sizes::new(z_layout.dims(), kernels_layout.dims());
        let (z, kernels) = (slice(z, z_layout)?, slice(kernels, kernels_layout)?);
        let call = Call::new(self, sizes, z, slice(weights, weights_layout)?, kernels);
        let dims = (self.window.all_targets().len(), sizes.channels_out);
        Ok((CpuStorage::F32(call.all_frames()), dims.into()))
    }

    fn bwd(
        &self,
        z: &Tensor,
        weights: &Tensor,
        kernels: &Tensor,
        _out: &Tensor,
        d_out: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let sizes = Sizes::new(z.dims(), kernels.dims());
        let d_out = d_out.contiguous()?;
        let arguments = [numbers(z)?, numbers(weights)?, numbers(kernels)?];
        let call = Call::new(self, sizes, &arguments[0], &arguments[1], &arguments[2]);
        let [dz, d_weights, d_kernels] = call.gradients(&numbers(&d_out)?);
        Ok((
            Some(tensor(dz, z.shape())?),
            Some(tensor(d_weights, weights.shape())?),
            Some(tensor(d_kernels, kernels.shape())?),
        ))
    }
}
