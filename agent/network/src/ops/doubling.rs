//! Normalisation, ReLU and a transposed convolution that doubles rows and columns, frame by frame: for each of
//! the output's four phases, a product of the kernels and the shifted input.
//!
//! Of each frame, only the channels that dropout keeps are stored and computed. Behind the normalisation a lost
//! channel is the constant `relu(b)`. This constant is taken off all frames, so that lost channels are zero,
//! and the constants of all channels go through the kernels once, as one more frame. Gradients follow the
//! same split.

use super::cpu::{Frames, add, frames, sum, total};
use super::norm::{Norm, NormGradient, Sums};
use super::product::{Left, Right, add_product, product, steps};
use super::taps::{PHASES, Sizes, TAPS};
use crate::dropout::Mask;

/// From the planes `z` that dropout keeps of each frame, before the normalisation, to those of the result.
pub(super) struct Doubling<'a> {
    pub(super) sizes: Sizes,
    /// `[channels in, channels out, 4, 4]`.
    pub(super) kernels: &'a [f32],
    /// Dropout of `z`.
    pub(super) input: &'a Mask,
    /// Dropout of the result.
    pub(super) output: &'a Mask,
    norm: Norm,
    /// The constants of lost channels; zero if there are none.
    floors: Vec<f32>,
    /// What becomes of them.
    constants: Vec<f32>,
}

/// Room for one frame.
pub(super) struct Room {
    /// One channel after normalisation and ReLU, less the constant.
    x: Vec<f32>,
    /// All of them, as [`Sizes::shift`] writes them.
    shifted: Vec<f32>,
    phases: Vec<f32>,
    views: Vec<f32>,
    padded: Vec<f32>,
    patches: Vec<f32>,
    /// The gradient of `x`.
    pub(super) dx: Vec<f32>,
}

/// Sums of the backward pass.
pub(super) struct Gradients {
    pub(super) room: Room,
    pub(super) kernels: Vec<f32>,
    /// Of the output, over frames.
    pub(super) d_out: Vec<f32>,
    pub(super) sums: Sums,
}

impl Room {
    /// What [`Doubling::read`] has left of a kept channel at a cell.
    #[inline(always)]
    pub(super) fn x_at(&self, sizes: &Sizes, index: usize, cell: usize) -> f32 {
        self.shifted[index * sizes.shifted() + sizes.unshifted() + cell]
    }
}

impl<'a> Doubling<'a> {
    pub(super) fn new(
        sizes: Sizes,
        kernels: &'a [f32],
        [input, output]: [&'a Mask; 2],
        norm: Norm,
    ) -> Self {
        let is_whole = input.keeps_all();
        let floor = |b: &f32| if is_whole { 0.0 } else { b.max(0.0) };
        let constants = vec![0.0; sizes.channels_out * sizes.out_area()];
        let mut doubling = Self {
            sizes,
            kernels,
            input,
            output,
            floors: norm.b.iter().map(floor).collect(),
            norm,
            constants,
        };
        if !is_whole {
            let (mut room, mut out) = (doubling.floors_in_room(), doubling.constants.clone());
            let [inputs, outputs] = doubling.all_channels();
            doubling.forward(&mut room, [&inputs, &outputs], &mut out);
            doubling.constants = out;
        }
        doubling
    }

    pub(super) fn room(&self) -> Room {
        let (sizes, zeros) = (&self.sizes, |n: usize| vec![0.0; n]);
        let area = sizes.area();
        Room {
            x: zeros(area),
            shifted: zeros(sizes.channels_in * sizes.shifted()),
            phases: zeros(sizes.channels_out * PHASES * area),
            views: zeros(sizes.channels_out * sizes.views()),
            padded: zeros(sizes.padded()),
            patches: zeros(area * TAPS),
            dx: zeros(sizes.channels_in * area),
        }
    }

    /// Every input and output channel.
    fn all_channels(&self) -> [Vec<usize>; 2] {
        [self.sizes.channels_in, self.sizes.channels_out].map(|n| (0..n).collect())
    }

    /// The constants as a frame.
    fn floors_in_room(&self) -> Room {
        let mut room = self.room();
        let shifted = room.shifted.chunks_exact_mut(self.sizes.shifted());
        for (floor, shifted) in self.floors.iter().zip(shifted) {
            room.x.fill(*floor);
            self.sizes.shift(&room.x, shifted);
        }
        room
    }

    /// A frame's kept channels, normalised and rectified, less the constants.
    #[inline(always)]
    pub(super) fn read(&self, frame: usize, z: &Frames, room: &mut Room) {
        let shifted = room.shifted.chunks_exact_mut(self.sizes.shifted());
        let z = z.frame(frame).chunks_exact(self.sizes.area());
        for ((channel, z), shifted) in self.input.kept(frame).iter().zip(z).zip(shifted) {
            let (a, b) = (self.norm.a[*channel], self.norm.b[*channel]);
            let floor = self.floors[*channel];
            for (x, z) in room.x.iter_mut().zip(z) {
                *x = (a * z + b).max(0.0) - floor;
            }
            self.sizes.shift(&room.x, shifted);
        }
    }

    /// Where the kernels of some inputs begin.
    fn kernels_of(&self, inputs: &[usize]) -> Vec<usize> {
        let length = self.sizes.channels_out * TAPS;
        inputs.iter().map(|input| input * length).collect()
    }

    /// What becomes of the frame in `room` of some channels, plus what becomes of the constants.
    #[inline(always)]
    pub(super) fn forward(
        &self,
        room: &mut Room,
        [inputs, outputs]: [&[usize]; 2],
        out: &mut [f32],
    ) {
        let (sizes, area, out_area) = (&self.sizes, self.sizes.area(), self.sizes.out_area());
        let (kernels, shifted) = (self.kernels_of(inputs), sizes.shifted());
        let rows: Vec<usize> = outputs.iter().map(|output| output * TAPS).collect();
        let to = steps(outputs.len(), out_area);
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
            product(&mut room.phases[phase * area..], &to, left, right);
        }
        let phases = room.phases.chunks_exact(out_area);
        let out = out.chunks_exact_mut(out_area);
        for ((output, phases), out) in outputs.iter().zip(phases).zip(out) {
            let start = &self.constants[output * out_area..][..out_area];
            sizes.interleave(phases, start, out);
        }
    }

    /// What becomes of the frame in `room` at one cell.
    #[inline(always)]
    pub(super) fn logits_at(
        &self,
        [row, col]: [usize; 2],
        frame: usize,
        room: &Room,
        logits: &mut [f32],
    ) {
        let (sizes, out_area) = (&self.sizes, self.sizes.out_area());
        for (state, logit) in logits.iter_mut().enumerate() {
            *logit = self.constants[state * out_area + row * 2 * sizes.cols + col];
        }
        for (tap, cell) in sizes.meets(row, col) {
            for (index, channel) in self.input.kept(frame).iter().enumerate() {
                let x = room.x_at(sizes, index, cell);
                let kernels = &self.kernels[channel * sizes.channels_out * TAPS..];
                let logits = logits.iter_mut().zip(kernels.chunks_exact(TAPS));
                logits.for_each(|(logit, kernel)| *logit += kernel[tap] * x);
            }
        }
    }

    /// The results of all frames, and the sums of their numbers and squares.
    pub(super) fn all_frames(&self, z: &Frames) -> (Frames, Sums) {
        let (input, output, area) = (self.input, self.output, self.sizes.out_area());
        let (out, chunks) = frames(
            input.n_frames(),
            |frame| output.kept(frame).len() * area,
            || (self.room(), Sums::new(self.sizes.channels_out)),
            #[inline(always)]
            |(room, sums), frame, out| {
                self.read(frame, z, room);
                self.forward(room, [input.kept(frame), output.kept(frame)], out);
                for (channel, out) in output.kept(frame).iter().zip(out.chunks_exact(area)) {
                    sums.add(*channel, out, out);
                }
            },
        );
        let sums: Vec<Sums> = chunks.into_iter().map(|(_, sums)| sums).collect();
        (out, Sums::total(&sums))
    }

    /// From the gradient of some outputs, that of the frame in `room`, in `room.dx`, and adds that of the
    /// kernels.
    #[inline(always)]
    pub(super) fn backward(
        &self,
        room: &mut Room,
        [inputs, outputs]: [&[usize]; 2],
        d_out: &[f32],
        d_kernels: &mut [f32],
    ) {
        let (sizes, area) = (&self.sizes, self.sizes.area());
        let (kernels, views) = (self.kernels_of(inputs), sizes.views());
        let d_out = d_out.chunks_exact(sizes.out_area());
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
        product(&mut room.dx, &steps(inputs.len(), area), left, right);
        self.add_kernel_gradient(room, [&kernels, outputs], d_out, d_kernels);
    }

    /// Adds the gradient of the kernels that begin at `kernels`, those of the inputs in `room`.
    #[inline(always)]
    fn add_kernel_gradient<'b>(
        &self,
        room: &mut Room,
        [kernels, outputs]: [&[usize]; 2],
        d_out: impl Iterator<Item = &'b [f32]>,
        d_kernels: &mut [f32],
    ) {
        let (sizes, area) = (&self.sizes, self.sizes.area());
        let x = Left {
            numbers: &room.shifted[sizes.unshifted()..],
            rows: &steps(kernels.len(), sizes.shifted()),
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
            add_product(&mut d_kernels[output * TAPS..], kernels, x, right);
        }
    }

    pub(super) fn gradients(&self) -> Gradients {
        Gradients {
            room: self.room(),
            kernels: vec![0.0; self.kernels.len()],
            d_out: vec![0.0; self.sizes.channels_out * self.sizes.out_area()],
            sums: Sums::new(self.sizes.channels_in),
        }
    }

    /// All gradients of the frame in `room` from that of its kept outputs: the one behind the normalisation in
    /// `dy`.
    #[inline(always)]
    pub(super) fn backward_of_frame(
        &self,
        to: &mut Gradients,
        (frame, z): (usize, &Frames),
        d_out: &[f32],
        dy: &mut [f32],
    ) {
        let channels = [self.input.kept(frame), self.output.kept(frame)];
        self.backward(&mut to.room, channels, d_out, &mut to.kernels);
        self.rectify(to, (frame, z), dy);
        let area = self.sizes.out_area();
        for (output, d_out) in channels[1].iter().zip(d_out.chunks_exact(area)) {
            add(&mut to.d_out[output * area..][..area], d_out);
        }
    }

    /// Takes `room.dx` back through the ReLU, and adds it to the normalisation's sums.
    #[inline(always)]
    pub(super) fn rectify(&self, to: &mut Gradients, (frame, z): (usize, &Frames), dy: &mut [f32]) {
        let area = self.sizes.area();
        let planes = z.frame(frame).chunks_exact(area);
        let planes = planes.zip(dy.chunks_exact_mut(area));
        let dx = to.room.dx.chunks_exact(area);
        for ((channel, dx), (z, dy)) in self.input.kept(frame).iter().zip(dx).zip(planes) {
            let (a, b) = (self.norm.a[*channel], self.norm.b[*channel]);
            for (dy, (z, dx)) in dy.iter_mut().zip(z.iter().zip(dx)) {
                *dy = if a * z + b > 0.0 { *dx } else { 0.0 };
            }
            to.sums.add(*channel, dy, z);
            if !self.input.keeps_all() {
                // What lost positions get is that of all, less this.
                to.sums.lost[*channel] -= f64::from(sum(dx));
            }
        }
    }

    /// The chunks' gradients of the kernels and through the normalisation, with those of the constants.
    pub(super) fn finish(&self, chunks: Vec<Gradients>) -> (Vec<f32>, NormGradient) {
        let (mut kernels, mut d_outs, mut sums) = (vec![], vec![], vec![]);
        for chunk in chunks {
            kernels.push(chunk.kernels);
            d_outs.push(chunk.d_out);
            sums.push(chunk.sums);
        }
        let (mut d_kernels, mut sums) = (total(kernels), Sums::total(&sums));
        if !self.input.keeps_all() {
            self.backward_of_floors(&total(d_outs), &mut d_kernels, &mut sums);
        }
        (d_kernels, self.norm.backward(&sums))
    }

    /// The constants' part: `d_out` is the sum over frames.
    fn backward_of_floors(&self, d_out: &[f32], d_kernels: &mut [f32], sums: &mut Sums) {
        let (mut room, [inputs, outputs]) = (self.floors_in_room(), self.all_channels());
        self.backward(&mut room, [&inputs, &outputs], d_out, d_kernels);
        let planes = room.dx.chunks_exact(self.sizes.area());
        for (channel, dx) in planes.enumerate() {
            let lost = sums.lost[channel] + f64::from(sum(dx));
            let is_above = self.norm.b[channel] > 0.0;
            sums.lost[channel] = if is_above { lost } else { 0.0 };
        }
    }

    /// Puts `dz` in place of a frame's `dy`.
    #[inline(always)]
    pub(super) fn normalise_gradient(
        &self,
        gradient: &NormGradient,
        (frame, z): (usize, &Frames),
        dy: &[f32],
        dz: &mut [f32],
    ) {
        let area = self.sizes.area();
        let planes = z.frame(frame).chunks_exact(area);
        let planes = planes.zip(dy.chunks_exact(area).zip(dz.chunks_exact_mut(area)));
        for (channel, (z, (dy, dz))) in self.input.kept(frame).iter().zip(planes) {
            let [p, q, r] = gradient.terms[*channel];
            for (dz, (dy, z)) in dz.iter_mut().zip(dy.iter().zip(z)) {
                *dz = p * dy + q * z + r;
            }
        }
    }
}
