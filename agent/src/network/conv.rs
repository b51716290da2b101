//! The encoder's convolutions, forward and backward, one frame at a time.
//!
//! Maps have their channels last, padded to whole lanes. The first convolution is evaluated only where a
//! cell was visited: its input is one-hot, so each visit adds one column of weights to each output that
//! it reaches. The others read the batch normalisation before them folded into their weights:
//! `W (s a + t) = (W s) a + W t`; there, channels lost to dropout are zero and skipped.

use super::batch_norm::Norm;
use super::correlation::{balanced, with_constant};
use super::lanes::{Arithmetic, Buffer, LANES, Lanes};
use super::shape::ConvShape;
use super::window::Visit;
use std::ops::Range;

/// Outputs computed at once by [`Dense::forward`]: as many sums as registers hold with ease.
const BLOCK: usize = 6;

/// Output channels of a backward pass that are taken at once, at most.
const OUTS: usize = 8;

/// The first convolution.
#[derive(Debug)]
pub(crate) struct Sparse {
    shape: ConvShape,
    /// `[observation][tap][channel]`.
    columns: Buffer,
    bias: Vec<f32>,
}

impl Sparse {
    /// From PyTorch's `[channel][observation][tap]`.
    pub(crate) fn new(shape: ConvShape, weight: &[f32], bias: &[f32]) -> Self {
        let n_columns = shape.channels_in * shape.taps();
        let channels = shape.channels_out;
        let columns = (0..weight.len())
            .map(|index| weight[index % channels * n_columns + index / channels])
            .collect::<Vec<f32>>();
        Self {
            shape,
            columns: Buffer::from(&*columns),
            bias: bias.to_vec(),
        }
    }

    /// Rows and columns of the outputs that one visit reaches.
    #[inline(always)]
    fn reached(&self, visit: Visit) -> [Range<usize>; 2] {
        let shape = &self.shape;
        let along = |axis: usize, at: usize| {
            let first = (at + 1)
                .saturating_sub(shape.kernel[axis])
                .div_ceil(shape.stride);
            first..(at / shape.stride + 1).min(shape.output[axis])
        };
        [
            along(0, usize::from(visit.row)),
            along(1, usize::from(visit.col)),
        ]
    }

    /// Where an output that a visit reaches begins, and the column of weights that it reaches it with.
    #[inline(always)]
    fn place(&self, visit: Visit, row: usize, col: usize) -> (usize, usize) {
        let shape = &self.shape;
        let down = usize::from(visit.row) - row * shape.stride;
        let right = usize::from(visit.col) - col * shape.stride;
        let column = usize::from(visit.value) * shape.taps() + down * shape.kernel[1] + right;
        let position = row * shape.output[1] + col;
        (position * shape.channels_out, column * shape.channels_out)
    }

    /// `relu(mask (W y + b))` of one frame; the mask has one number per channel.
    #[inline(always)]
    pub(crate) fn forward<A: Arithmetic>(&self, visits: &[Visit], mask: &[f32], out: &mut [f32]) {
        let channels = self.shape.channels_out;
        for position in out.chunks_exact_mut(channels) {
            position.copy_from_slice(&self.bias);
        }
        for &visit in visits {
            let [rows, cols] = self.reached(visit);
            for row in rows {
                for col in cols.clone() {
                    let (position, column) = self.place(visit, row, col);
                    let column = &self.columns[column..][..channels];
                    add_lanes::<A>(&mut out[position..][..channels], column);
                }
            }
        }
        for position in out.chunks_exact_mut(channels) {
            for (value, factor) in position.iter_mut().zip(mask) {
                *value = (*value * factor).max(0.0);
            }
        }
    }

    /// Adds one frame's gradients: `d_columns` in the layout of the columns, `d_bias` per channel.
    #[inline(always)]
    pub(crate) fn backward<A: Arithmetic>(
        &self,
        visits: &[Visit],
        dz: &[f32],
        d_columns: &mut [f32],
        d_bias: &mut [f32],
    ) {
        let channels = self.shape.channels_out;
        for position in dz.chunks_exact(channels) {
            add_lanes::<A>(d_bias, position);
        }
        for &visit in visits {
            let [rows, cols] = self.reached(visit);
            for row in rows {
                for col in cols.clone() {
                    let (position, column) = self.place(visit, row, col);
                    let column = &mut d_columns[column..][..channels];
                    add_lanes::<A>(column, &dz[position..][..channels]);
                }
            }
        }
    }

    /// Gradients in PyTorch's layout.
    pub(crate) fn weight_gradient(&self, d_columns: &[f32]) -> Vec<f32> {
        let n_columns = self.shape.channels_in * self.shape.taps();
        let channels = self.shape.channels_out;
        (0..d_columns.len())
            .map(|index| d_columns[index % n_columns * channels + index / n_columns])
            .collect()
    }
}

#[inline(always)]
fn add_lanes<A: Arithmetic>(sums: &mut [f32], x: &[f32]) {
    for (sums, x) in sums.as_chunks_mut().0.iter_mut().zip(x.as_chunks().0) {
        *sums = Lanes(*sums).add::<A>(Lanes(*x)).0;
    }
}

/// A convolution of a normalised map.
#[derive(Debug)]
pub(crate) struct Dense {
    shape: ConvShape,
    /// The input's normalisation is folded in: `[tap][in]`, one lane per output channel.
    folded: Vec<Lanes>,
    bias: Lanes,
    /// As it is: `[out][tap][in]`.
    weight: Buffer,
    input: Norm,
}

/// One frame's gradients of a [`Dense`] convolution are added to these.
#[derive(Debug, Clone)]
pub(crate) struct DenseGradient {
    /// Of the folded weights, `[out][tap][in]`.
    pub(crate) weight: Buffer,
    pub(crate) bias: Buffer,
}

impl DenseGradient {
    pub(crate) fn zeros(shape: &ConvShape) -> Self {
        Self {
            weight: Buffer::zeros(shape.channels_out * shape.taps() * shape.channels_in),
            bias: Buffer::zeros(shape.lanes_out()),
        }
    }

    pub(crate) fn clear(&mut self) {
        self.weight.fill(0.0);
        self.bias.fill(0.0);
    }

    pub(crate) fn add(&mut self, other: &Self) {
        for (sum, x) in self.weight.iter_mut().zip(&*other.weight) {
            *sum += x;
        }
        for (sum, x) in self.bias.iter_mut().zip(&*other.bias) {
            *sum += x;
        }
    }
}

impl Dense {
    /// From PyTorch's `[out][in][tap]` and the normalisation of the input.
    pub(crate) fn new(shape: ConvShape, weight: &[f32], bias: &[f32], input: &Norm) -> Self {
        assert!(shape.channels_out <= LANES && [1, 2].contains(&(shape.channels_in / LANES)));
        let (taps, channels_in) = (shape.taps(), shape.channels_in);
        let mut conv = Self {
            shape,
            folded: vec![Lanes::ZERO; taps * channels_in],
            bias: Lanes::ZERO,
            weight: Buffer::zeros(weight.len()),
            input: input.clone(),
        };
        for out in 0..shape.channels_out {
            conv.bias.0[out] = bias[out];
            for channel in 0..channels_in {
                for tap in 0..taps {
                    let entry = weight[(out * channels_in + channel) * taps + tap];
                    conv.folded[tap * channels_in + channel].0[out] = entry * input.scale[channel];
                    conv.bias.0[out] += entry * input.shift[channel];
                    conv.weight[(out * taps + tap) * channels_in + channel] = entry;
                }
            }
        }
        conv
    }

    /// Numbers per input position.
    pub(crate) fn inputs(&self) -> usize {
        self.shape.channels_in
    }

    /// Where the input of an output's tap begins.
    #[inline(always)]
    fn input_at(&self, out_row: usize, out_col: usize, tap: usize) -> usize {
        let row = out_row * self.shape.stride + tap / self.shape.kernel[1];
        let col = out_col * self.shape.stride + tap % self.shape.kernel[1];
        (row * self.shape.input[1] + col) * self.shape.channels_in
    }

    /// `relu(mask (W x + b))` of one frame, of the input channels that are kept.
    #[inline(always)]
    pub(crate) fn forward<A: Arithmetic>(
        &self,
        input: &[f32],
        kept: &[u16],
        mask: &[f32],
        out: &mut [f32],
    ) {
        match self.shape.channels_in {
            LANES => self.write_rows::<A, LANES>(input, kept, mask, out),
            _ => self.write_rows::<A, { 2 * LANES }>(input, kept, mask, out),
        }
    }

    /// Of `INPUTS` input channels.
    #[inline(always)]
    fn write_rows<A: Arithmetic, const INPUTS: usize>(
        &self,
        input: &[f32],
        kept: &[u16],
        mask: &[f32],
        out: &mut [f32],
    ) {
        let [rows, cols] = self.shape.output;
        let mut out = out.as_chunks_mut::<LANES>().0.iter_mut();
        for row in 0..rows {
            for first in (0..cols).step_by(BLOCK) {
                let sums = self.block::<A, INPUTS>(input, kept, row, first);
                for (sum, out) in sums[..BLOCK.min(cols - first)].iter().zip(&mut out) {
                    for lane in 0..LANES {
                        out[lane] = (sum.0[lane] * mask[lane]).max(0.0);
                    }
                }
            }
        }
    }

    /// Up to [`BLOCK`] outputs of a row; those beyond the row's end are worthless.
    #[inline(always)]
    fn block<A: Arithmetic, const INPUTS: usize>(
        &self,
        input: &[f32],
        kept: &[u16],
        row: usize,
        first: usize,
    ) -> [Lanes; BLOCK] {
        let last = self.shape.output[1] - 1;
        let positions = input.as_chunks::<INPUTS>().0;
        let mut sums = [self.bias; BLOCK];
        for (tap, weights) in self.folded.as_chunks::<INPUTS>().0.iter().enumerate() {
            let mut inputs = [&positions[0]; BLOCK];
            for (at, inputs) in inputs.iter_mut().enumerate() {
                let position = self.input_at(row, (first + at).min(last), tap) / INPUTS;
                *inputs = &positions[position];
            }
            for &channel in kept {
                let channel = usize::from(channel) % INPUTS;
                for at in 0..BLOCK {
                    sums[at] = sums[at].add_scaled::<A>(inputs[at][channel], weights[channel]);
                }
            }
        }
        sums
    }

    /// From `dz` of one frame and the output channels it keeps: the gradient of the normalised input,
    /// written to `dx`, and those of the folded parameters, added to `gradient`.
    #[inline(always)]
    pub(crate) fn backward<A: Arithmetic>(
        &self,
        input: &[f32],
        kept: &[u16],
        dz: &[f32],
        dx: &mut [f32],
        gradient: &mut DenseGradient,
    ) {
        dx.fill(0.0);
        for position in dz.chunks_exact(LANES) {
            add_lanes::<A>(&mut gradient.bias, position);
        }
        for tap in 0..self.shape.taps() {
            for outs in balanced(kept, OUTS) {
                let place = Place { tap, outs };
                let to = (&mut *dx, &mut *gradient.weight);
                if self.shape.channels_in == LANES {
                    with_constant!(
                        outs.len(), both, [1 2 3 4 5 6 7 8], 1,
                        (self, place, input, dz, to)
                    );
                } else {
                    with_constant!(
                        outs.len(), both, [1 2 3 4 5 6 7 8], 2,
                        (self, place, input, dz, to)
                    );
                }
            }
        }
    }

    /// Both gradients of a part: to `dx`, and to the weights'.
    #[inline(always)]
    fn both<A: Arithmetic, const OUTS: usize, const VECTORS: usize>(
        &self,
        place: Place<'_>,
        input: &[f32],
        dz: &[f32],
        (dx, d_weight): (&mut [f32], &mut [f32]),
    ) {
        self.input_gradient::<A, OUTS, VECTORS>(place, dz, dx);
        self.weight_gradient::<A, OUTS, VECTORS>(place, input, dz, d_weight);
    }

    /// Calls `each` with every output's `dz` and with where the inputs of a place begin.
    #[inline(always)]
    fn each_output(
        &self,
        place: Place<'_>,
        dz: &[f32],
        mut each: impl FnMut(&[f32; LANES], usize),
    ) {
        let cols = self.shape.output[1];
        let step = self.shape.stride * self.shape.channels_in;
        for (row, dz) in dz.as_chunks().0.chunks_exact(cols).enumerate() {
            let first = self.input_at(row, 0, place.tap);
            for (col, dz) in dz.iter().enumerate() {
                each(dz, first + col * step);
            }
        }
    }

    /// Of `VECTORS` times sixteen input channels, through `OUTS` outputs.
    #[inline(always)]
    fn input_gradient<A: Arithmetic, const OUTS: usize, const VECTORS: usize>(
        &self,
        place: Place<'_>,
        dz: &[f32],
        dx: &mut [f32],
    ) {
        let (at, mut weights) = (places::<OUTS>(place.outs), [[Lanes::ZERO; VECTORS]; OUTS]);
        for (weights, &out) in weights.iter_mut().zip(place.outs) {
            *weights = Lanes::load_all(&self.weight[self.weight_at(out, place.tap)..]);
        }
        self.each_output(place, dz, |dz, input| {
            let dx = &mut dx[input..][..VECTORS * LANES];
            let mut sums = Lanes::load_all::<VECTORS>(dx);
            for out in 0..OUTS {
                for (sum, weights) in sums.iter_mut().zip(weights[out]) {
                    *sum = sum.add_scaled::<A>(dz[at[out]], weights);
                }
            }
            for (dx, sum) in dx.as_chunks_mut().0.iter_mut().zip(sums) {
                *dx = sum.0;
            }
        });
    }

    /// From `VECTORS` times sixteen input channels to `OUTS` outputs.
    #[inline(always)]
    fn weight_gradient<A: Arithmetic, const OUTS: usize, const VECTORS: usize>(
        &self,
        place: Place<'_>,
        input: &[f32],
        dz: &[f32],
        gradient: &mut [f32],
    ) {
        let (at, mut sums) = (places::<OUTS>(place.outs), [[Lanes::ZERO; VECTORS]; OUTS]);
        self.each_output(place, dz, |dz, first| {
            let x = Lanes::load_all::<VECTORS>(&input[first..]);
            for out in 0..OUTS {
                for (sum, x) in sums[out].iter_mut().zip(x) {
                    *sum = sum.add_scaled::<A>(dz[at[out]], x);
                }
            }
        });
        for (sums, &out) in sums.iter().zip(place.outs) {
            let gradient = &mut gradient[self.weight_at(out, place.tap)..];
            for (gradient, sum) in gradient.as_chunks_mut().0.iter_mut().zip(sums) {
                *gradient = sum.add::<A>(Lanes(*gradient)).0;
            }
        }
    }

    #[inline(always)]
    fn weight_at(&self, out: u16, tap: usize) -> usize {
        (usize::from(out) * self.shape.taps() + tap) * self.shape.channels_in
    }

    /// Gradients of weight and bias in PyTorch's layout: through the folding, `dW = s d(W s) + t db`.
    pub(crate) fn unfold(&self, gradient: &DenseGradient) -> (Vec<f32>, Vec<f32>) {
        let (taps, channels) = (self.shape.taps(), self.shape.channels_in);
        let weight = (0..gradient.weight.len()).map(|index| {
            let (out, channel, tap) = (
                index / (channels * taps),
                index / taps % channels,
                index % taps,
            );
            let folded = gradient.weight[(out * taps + tap) * channels + channel];
            folded * self.input.scale[channel] + gradient.bias[out] * self.input.shift[channel]
        });
        let bias = gradient.bias[..self.shape.channels_out].to_vec();
        (weight.collect(), bias)
    }
}

/// Which weights a part of the backward pass is about.
#[derive(Clone, Copy)]
struct Place<'a> {
    tap: usize,
    /// Up to [`OUTS`] output channels.
    outs: &'a [u16],
}

/// The lanes of as many channels.
#[inline(always)]
fn places<const OUTS: usize>(outs: &[u16]) -> [usize; OUTS] {
    let mut places = [0; OUTS];
    for (place, &out) in places.iter_mut().zip(outs) {
        *place = usize::from(out) % LANES;
    }
    places
}
