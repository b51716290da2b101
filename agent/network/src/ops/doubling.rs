//! Normalisation, ReLU and a transposed convolution that doubles rows and columns, frame by frame: a product
//! with the kernels, then sums of its shifted parts.
//!
//! Of each frame, only the channels that dropout keeps are read and computed. Behind the normalisation a lost
//! channel is the constant `relu(b)`. This constant is taken off all frames, so that lost channels are zero,
//! and the constants of all channels go through the kernels once, as one more frame. Gradients follow the
//! same split.

use super::cpu::{add, frames, matrix, numbers, product, slice, tensor, total};
use super::norm::{Moments, Norm, Sums, finish};
use super::taps::{Sizes, TAPS, join, split};
use crate::dropout::Mask;
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor};

/// Arguments: `z [frames, channels in, rows, cols]` before its dropout; `[gamma; beta]`; kernels `[channels in,
/// channels out, 4, 4]`. The result is zero, and its gradient not read, at channels that `output` loses.
pub(crate) struct Doubling {
    /// Dropout of `z`.
    pub(crate) input: Mask,
    /// Dropout of the result.
    pub(crate) output: Mask,
    /// Of `z` after its dropout.
    pub(crate) moments: Moments,
}

/// Room for one frame.
struct Room {
    x: Vec<f32>,
    dx: Vec<f32>,
    kernels: Vec<f32>,
    d_kernels: Vec<f32>,
    taps: Vec<f32>,
}

/// One call: what all frames share.
struct Call<'a> {
    op: &'a Doubling,
    sizes: Sizes,
    norm: Norm,
    /// The constants of lost channels; zero if there are none.
    floors: Vec<f32>,
    z: &'a [f32],
    kernels: &'a [f32],
    every_channel: Vec<usize>,
}

/// One chunk's sums in the backward pass.
struct Gradients {
    room: Room,
    kernels: Vec<f32>,
    /// Of the output, over frames.
    d_out: Vec<f32>,
    sums: Sums,
}

impl Room {
    fn new(sizes: &Sizes) -> Self {
        let kernels = sizes.channels_in * sizes.channels_out * TAPS;
        Self {
            x: vec![0.0; sizes.per_input()],
            dx: vec![0.0; sizes.per_input()],
            kernels: vec![0.0; kernels],
            d_kernels: vec![0.0; kernels],
            taps: vec![0.0; sizes.per_output() * TAPS / 4],
        }
    }
}

impl<'a> Call<'a> {
    fn new(
        op: &'a Doubling,
        sizes: Sizes,
        z: &'a [f32],
        weights: &[f32],
        kernels: &'a [f32],
    ) -> Self {
        let norm = Norm::new(weights, &op.moments, op.input.scale());
        let is_whole = op.input.keeps_all();
        let floor = |b: &f32| if is_whole { 0.0 } else { b.max(0.0) };
        Self {
            floors: norm.b.iter().map(floor).collect(),
            every_channel: (0..sizes.channels_in.max(sizes.channels_out)).collect(),
            op,
            sizes,
            norm,
            z,
            kernels,
        }
    }

    /// The constants as a frame.
    fn floors_as_frame(&self) -> Vec<f32> {
        let area = self.sizes.area();
        let floors = self.floors.iter();
        floors
            .flat_map(|floor| std::iter::repeat_n(*floor, area))
            .collect()
    }

    /// Input and output channels.
    fn all_channels(&self) -> [&[usize]; 2] {
        let Sizes {
            channels_in,
            channels_out,
            ..
        } = self.sizes;
        [channels_in, channels_out].map(|n| &self.every_channel[..n])
    }

    fn kept(&self, frame: usize) -> [&[usize]; 2] {
        [self.op.input.kept(frame), self.op.output.kept(frame)]
    }

    /// A frame's kept channels, normalised and rectified, less the constants.
    #[inline(always)]
    fn read(&self, z: &[f32], inputs: &[usize], x: &mut [f32]) {
        let area = self.sizes.area();
        for (&channel, x) in inputs.iter().zip(x.chunks_exact_mut(area)) {
            let (a, b, floor) = (
                self.norm.a[channel],
                self.norm.b[channel],
                self.floors[channel],
            );
            for (x, z) in x.iter_mut().zip(&z[channel * area..]) {
                *x = (a * z + b).max(0.0) - floor;
            }
        }
    }

    /// The kernels between some channels.
    #[inline(always)]
    fn gather(&self, [inputs, outputs]: [&[usize]; 2], kernels: &mut [f32]) {
        let n = self.sizes.channels_out;
        let (from, _) = self.kernels.as_chunks::<TAPS>();
        let (to, _) = kernels.as_chunks_mut::<TAPS>();
        for (input, to) in inputs.iter().zip(to.chunks_exact_mut(outputs.len().max(1))) {
            let from = &from[input * n..][..n];
            for (output, to) in outputs.iter().zip(to) {
                *to = from[*output];
            }
        }
    }

    /// Adds what becomes of the frame `room.x` of some channels to its output.
    #[inline(always)]
    fn forward(&self, room: &mut Room, channels: [&[usize]; 2], out: &mut [f32]) {
        let [inputs, outputs] = channels;
        let (area, n_taps) = (self.sizes.area(), outputs.len() * TAPS);
        self.gather(channels, &mut room.kernels);
        let kernels = matrix(&room.kernels, inputs.len(), n_taps);
        let x = matrix(&room.x, inputs.len(), area);
        product(&mut room.taps, kernels.t(), x, false);
        for (output, taps) in outputs.iter().zip(room.taps.chunks_exact(TAPS * area)) {
            let out = &mut out[output * 4 * area..][..4 * area];
            join(taps, out, self.sizes.cols);
        }
    }

    /// From the gradient of the output, that of the frame `room.x`, in `room.dx`, and adds that of the kernels.
    #[inline(always)]
    fn backward(
        &self,
        room: &mut Room,
        channels: [&[usize]; 2],
        d_out: &[f32],
        d_kernels: &mut [f32],
    ) {
        let [inputs, outputs] = channels;
        let (area, n_taps) = (self.sizes.area(), outputs.len() * TAPS);
        self.gather(channels, &mut room.kernels);
        for (output, taps) in outputs.iter().zip(room.taps.chunks_exact_mut(TAPS * area)) {
            split(
                taps,
                &d_out[output * 4 * area..][..4 * area],
                self.sizes.cols,
            );
        }
        let taps = matrix(&room.taps, n_taps, area);
        let kernels = matrix(&room.kernels, inputs.len(), n_taps);
        product(&mut room.dx, kernels, taps, false);
        let x = matrix(&room.x, inputs.len(), area);
        product(&mut room.d_kernels, x, taps.t(), false);
        let (from, _) = room.d_kernels.as_chunks::<TAPS>();
        let (to, _) = d_kernels.as_chunks_mut::<TAPS>();
        for (input, from) in inputs.iter().zip(from.chunks_exact(outputs.len().max(1))) {
            let to = &mut to[input * self.sizes.channels_out..][..self.sizes.channels_out];
            for (output, from) in outputs.iter().zip(from) {
                add(&mut to[*output], from);
            }
        }
    }

    fn frame_of_z(&self, frame: usize) -> &[f32] {
        let length = self.sizes.per_input();
        &self.z[frame * length..][..length]
    }

    /// What becomes of the constants.
    fn output_of_floors(&self) -> Vec<f32> {
        let mut room = Room {
            x: self.floors_as_frame(),
            ..Room::new(&self.sizes)
        };
        let mut out = vec![0.0; self.sizes.per_output()];
        self.forward(&mut room, self.all_channels(), &mut out);
        out
    }

    fn all_frames(&self) -> Vec<f32> {
        let (area, per_output) = (4 * self.sizes.area(), self.sizes.per_output());
        let constant = (!self.op.input.keeps_all()).then(|| self.output_of_floors());
        let mut out = vec![0.0; self.op.input.n_frames() * per_output];
        let new = || Room::new(&self.sizes);
        frames(&mut out, per_output, new, |room, frame, out| {
            let [inputs, outputs] = self.kept(frame);
            self.read(self.frame_of_z(frame), inputs, &mut room.x);
            if let Some(constant) = &constant {
                for output in outputs {
                    let at = output * area..(output + 1) * area;
                    out[at.clone()].copy_from_slice(&constant[at]);
                }
            }
            self.forward(room, [inputs, outputs], out);
        });
        out
    }
}

impl Call<'_> {
    /// Gradients of `z`, of `[gamma; beta]` and of the kernels.
    fn gradients(&self, d_out: &[f32]) -> [Vec<f32>; 3] {
        let mut dz = vec![0.0; self.z.len()];
        let new = || Gradients {
            room: Room::new(&self.sizes),
            kernels: vec![0.0; self.kernels.len()],
            d_out: vec![0.0; self.sizes.per_output()],
            sums: Sums::new(self.sizes.channels_in),
        };
        let per_output = self.sizes.per_output();
        let chunks = frames(&mut dz, self.sizes.per_input(), new, |chunk, frame, dz| {
            let d_out = &d_out[frame * per_output..][..per_output];
            self.gradients_of_frame(chunk, frame, d_out, dz);
        });
        let (mut kernels, mut d_outs, mut sums) = (vec![], vec![], vec![]);
        for chunk in chunks {
            kernels.push(chunk.kernels);
            d_outs.push(chunk.d_out);
            sums.push(chunk.sums);
        }
        let (mut d_kernels, mut sums) = (total(kernels), Sums::total(sums));
        if !self.op.input.keeps_all() {
            self.gradients_of_floors(&total(d_outs), &mut d_kernels, &mut sums);
        }
        let (d_weights, terms) = self.norm.backward(&sums);
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
        let ([inputs, outputs], area) = (self.kept(frame), self.sizes.area());
        let z = self.frame_of_z(frame);
        self.read(z, inputs, &mut chunk.room.x);
        let channels = [inputs, outputs];
        self.backward(&mut chunk.room, channels, d_out, &mut chunk.kernels);
        for (&channel, dx) in inputs.iter().zip(chunk.room.dx.chunks_exact(area)) {
            let at = channel * area..(channel + 1) * area;
            let (z, dz) = (&z[at.clone()], &mut dz[at]);
            let (a, b) = (self.norm.a[channel], self.norm.b[channel]);
            for (dz, (z, dx)) in dz.iter_mut().zip(z.iter().zip(dx)) {
                *dz = if a * z + b > 0.0 { *dx } else { 0.0 };
            }
            chunk.sums.add(channel, dz, z);
            if !self.op.input.keeps_all() {
                // What lost positions get is that of all, less this.
                chunk.sums.lost[channel] -= f64::from(dx.iter().sum::<f32>());
            }
        }
        for output in outputs {
            let at = output * 4 * area..(output + 1) * 4 * area;
            add(&mut chunk.d_out[at.clone()], &d_out[at]);
        }
    }

    /// The constants' part: `d_out` is the sum over frames.
    fn gradients_of_floors(&self, d_out: &[f32], d_kernels: &mut [f32], sums: &mut Sums) {
        let mut room = Room {
            x: self.floors_as_frame(),
            ..Room::new(&self.sizes)
        };
        self.backward(&mut room, self.all_channels(), d_out, d_kernels);
        let planes = room.dx.chunks_exact(self.sizes.area());
        for (channel, dx) in planes.enumerate() {
            let lost = sums.lost[channel] + f64::from(dx.iter().sum::<f32>());
            sums.lost[channel] = if self.norm.b[channel] > 0.0 {
                lost
            } else {
                0.0
            };
        }
    }
}

impl CustomOp3 for Doubling {
    fn name(&self) -> &'static str {
        "doubling"
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
        let dims = (
            self.input.n_frames(),
            sizes.channels_out,
            2 * sizes.rows,
            2 * sizes.cols,
        );
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
