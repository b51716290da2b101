//! Normalisation, ReLU and a transposed convolution that doubles rows and columns, frame by frame: for each of
//! the output's four phases, a product of the kernels and the shifted input.
//!
//! Of each frame, only the channels that dropout keeps are stored and computed. Behind the normalisation a lost
//! channel is the constant `relu(b)`. This constant is taken off all frames, so that lost channels are zero,
//! and the constants of all channels go through the kernels once, as one more frame. Gradients follow the
//! same split.

use super::cpu::{add, frames, numbers, slice, tensor, total};
use super::norm::{Moments, Norm, Sums, finish};
use super::planes::Planes;
use super::product::{Left, Right, add_product, steps};
use super::taps::{PHASES, Sizes, TAPS};
use crate::dropout::Mask;
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor};

/// Arguments: `z [planes, rows, cols]` before its dropout, of all channels or of those that it keeps; `[gamma;
/// beta]`; kernels `[channels in, channels out, 4, 4]`. The result has the planes that `output` keeps.
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
    /// One channel after normalisation and ReLU, less the constant.
    x: Vec<f32>,
    shifted: Vec<f32>,
    phases: Vec<f32>,
    views: Vec<f32>,
    padded: Vec<f32>,
    patches: Vec<f32>,
    dx: Vec<f32>,
}

/// One call: what all frames share.
struct Call<'a> {
    op: &'a Doubling,
    sizes: Sizes,
    norm: Norm,
    /// The constants of lost channels; zero if there are none.
    floors: Vec<f32>,
    z: Planes<'a>,
    kernels: &'a [f32],
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
        let (area, zeros) = (sizes.area(), |n: usize| vec![0.0; n]);
        Self {
            x: zeros(area),
            shifted: zeros(sizes.channels_in * sizes.shifted()),
            phases: zeros(sizes.channels_out * PHASES * area),
            views: zeros(sizes.channels_out * sizes.views()),
            padded: zeros(sizes.padded()),
            patches: zeros(area * TAPS),
            dx: zeros(sizes.channels_in * area),
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
            z: Planes::new(z, sizes.area(), &op.input),
            op,
            sizes,
            norm,
            kernels,
        }
    }

    /// Numbers of an output channel.
    fn out_area(&self) -> usize {
        PHASES * self.sizes.area()
    }

    /// Every input and output channel.
    fn all_channels(&self) -> [Vec<usize>; 2] {
        [self.sizes.channels_in, self.sizes.channels_out].map(|n| (0..n).collect())
    }

    /// The constants as a frame.
    fn write_floors(&self, room: &mut Room) {
        let shifted = room.shifted.chunks_exact_mut(self.sizes.shifted());
        for (floor, shifted) in self.floors.iter().zip(shifted) {
            room.x.fill(*floor);
            self.sizes.shift(&room.x, shifted);
        }
    }

    /// A frame's kept channels, normalised and rectified, less the constants.
    #[inline(always)]
    fn read(&self, frame: usize, room: &mut Room) {
        let shifted = room.shifted.chunks_exact_mut(self.sizes.shifted());
        for ((channel, z), shifted) in self.z.kept(frame).zip(shifted) {
            let (a, b) = (self.norm.a[channel], self.norm.b[channel]);
            let floor = self.floors[channel];
            for (x, z) in room.x.iter_mut().zip(z) {
                *x = (a * z + b).max(0.0) - floor;
            }
            self.sizes.shift(&room.x, shifted);
        }
    }

    /// Where the kernels of some inputs begin.
    fn kernels_of(&self, inputs: &[usize]) -> Vec<usize> {
        let places = inputs
            .iter()
            .map(|input| input * self.sizes.channels_out * TAPS);
        places.collect()
    }

    /// What becomes of the frame in `room` of some channels, plus what becomes of the constants.
    #[inline(always)]
    fn forward(
        &self,
        room: &mut Room,
        [inputs, outputs]: [&[usize]; 2],
        constants: &[f32],
        out: &mut [f32],
    ) {
        let (sizes, area) = (&self.sizes, self.sizes.area());
        let (kernels, shifted) = (self.kernels_of(inputs), sizes.shifted());
        let rows: Vec<usize> = outputs.iter().map(|output| output * TAPS).collect();
        room.phases.fill(0.0);
        for phase in 0..PHASES {
            let terms = sizes.terms(phase);
            let terms = kernels.iter().enumerate().flat_map(|(index, kernel)| {
                terms.map(|(tap, from)| (kernel + tap, index * shifted + from))
            });
            let (left_terms, right_terms): (Vec<_>, Vec<_>) = terms.unzip();
            let left = Left {
                numbers: self.kernels,
                rows: &rows,
                terms: &left_terms,
            };
            let right = Right {
                numbers: &room.shifted,
                terms: &right_terms,
                cols: area,
            };
            let to = steps(outputs.len(), PHASES * area);
            add_product(&mut room.phases[phase * area..], &to, left, right);
        }
        let phases = room.phases.chunks_exact(PHASES * area);
        let out = out.chunks_exact_mut(PHASES * area);
        for ((output, phases), out) in outputs.iter().zip(phases).zip(out) {
            let start = &constants[output * PHASES * area..][..PHASES * area];
            sizes.interleave(phases, start, out);
        }
    }

    /// From the gradient of some outputs, that of the frame in `room`, in `room.dx`, and adds that of the
    /// kernels.
    #[inline(always)]
    fn backward(
        &self,
        room: &mut Room,
        [inputs, outputs]: [&[usize]; 2],
        d_out: &[f32],
        d_kernels: &mut [f32],
    ) {
        let (sizes, area) = (&self.sizes, self.sizes.area());
        let (kernels, views) = (self.kernels_of(inputs), sizes.views());
        let d_out = d_out.chunks_exact(PHASES * area);
        for (d_out, views) in d_out.clone().zip(room.views.chunks_exact_mut(views)) {
            sizes.split(d_out, views);
        }
        let terms = outputs.iter().enumerate().flat_map(|(index, output)| {
            (0..TAPS).map(move |tap| (output * TAPS + tap, index * views + sizes.view(tap)))
        });
        let (left_terms, right_terms): (Vec<_>, Vec<_>) = terms.unzip();
        let left = Left {
            numbers: self.kernels,
            rows: &kernels,
            terms: &left_terms,
        };
        let right = Right {
            numbers: &room.views,
            terms: &right_terms,
            cols: area,
        };
        let to = steps(inputs.len(), area);
        room.dx.fill(0.0);
        add_product(&mut room.dx, &to, left, right);
        let x = Left {
            numbers: &room.shifted[sizes.unshifted()..],
            rows: &steps(inputs.len(), sizes.shifted()),
            terms: &steps(area, 1),
        };
        let cells = steps(area, TAPS);
        for (output, d_out) in outputs.iter().zip(d_out) {
            sizes.patches(d_out, &mut room.padded, &mut room.patches);
            let right = Right {
                numbers: &room.patches,
                terms: &cells,
                cols: TAPS,
            };
            add_product(&mut d_kernels[output * TAPS..], &kernels, x, right);
        }
    }

    /// What becomes of the constants.
    fn output_of_floors(&self) -> Vec<f32> {
        let zeros = vec![0.0; self.sizes.channels_out * self.out_area()];
        let mut out = zeros.clone();
        if !self.op.input.keeps_all() {
            let (mut room, [inputs, outputs]) = (Room::new(&self.sizes), self.all_channels());
            self.write_floors(&mut room);
            self.forward(&mut room, [&inputs, &outputs], &zeros, &mut out);
        }
        out
    }

    fn all_frames(&self) -> Vec<f32> {
        let (constants, area) = (self.output_of_floors(), self.out_area());
        let [input, output] = [&self.op.input, &self.op.output];
        let mut out = vec![0.0; output.start(output.n_frames()) * area];
        let new = || Room::new(&self.sizes);
        let start = |frame: usize| output.start(frame) * area;
        frames(
            &mut out,
            input.n_frames(),
            start,
            new,
            #[inline(always)]
            |room, frame, out| {
                self.read(frame, room);
                let channels = [input.kept(frame), output.kept(frame)];
                self.forward(room, channels, &constants, out);
            },
        );
        out
    }

    /// Gradients of `z`, of `[gamma; beta]` and of the kernels.
    fn gradients(&self, d_out: &[f32]) -> [Vec<f32>; 3] {
        let mut dz = vec![0.0; self.z.len()];
        let new = || Gradients {
            room: Room::new(&self.sizes),
            kernels: vec![0.0; self.kernels.len()],
            d_out: vec![0.0; self.sizes.channels_out * self.out_area()],
            sums: Sums::new(self.sizes.channels_in),
        };
        let n_frames = self.op.input.n_frames();
        let start = |frame| self.z.start(frame);
        let chunks = frames(
            &mut dz,
            n_frames,
            start,
            new,
            #[inline(always)]
            |chunk, frame, dz| {
                let d_out = &d_out[self.op.output.start(frame) * self.out_area()..];
                self.gradients_of_frame(chunk, frame, d_out, dz);
            },
        );
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
        finish(&terms, &self.z, &mut dz);
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
        let area = self.sizes.area();
        let channels = [self.op.input.kept(frame), self.op.output.kept(frame)];
        self.read(frame, &mut chunk.room);
        self.backward(&mut chunk.room, channels, d_out, &mut chunk.kernels);
        let dx = chunk.room.dx.chunks_exact(area);
        for (index, ((channel, z), dx)) in self.z.kept(frame).zip(dx).enumerate() {
            let dz = &mut dz[self.z.place(frame, index)..][..area];
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
        let area = self.out_area();
        for (output, d_out) in channels[1].iter().zip(d_out.chunks_exact(area)) {
            add(&mut chunk.d_out[output * area..][..area], d_out);
        }
    }

    /// The constants' part: `d_out` is the sum over frames.
    fn gradients_of_floors(&self, d_out: &[f32], d_kernels: &mut [f32], sums: &mut Sums) {
        let (mut room, [inputs, outputs]) = (Room::new(&self.sizes), self.all_channels());
        self.write_floors(&mut room);
        self.backward(&mut room, [&inputs, &outputs], d_out, d_kernels);
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
        let n_planes = self.output.start(self.output.n_frames());
        let dims = (n_planes, 2 * sizes.rows, 2 * sizes.cols);
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
