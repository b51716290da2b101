//! One convolution of a chain over all frames, with its gradients.
//!
//! Only the convolutions' results are stored between the passes over the frames. Activations are recomputed. A
//! convolution is linear, so `conv(x) = conv(x - floors) + conv(floors)`. In the first term, dropped channels are zero
//! and are skipped. The second term is the same for all frames and is computed once. Gradients are split in the same
//! way.

use super::activation::{Activation, Order, ResultGradient};
use super::conv::{Buffers, Conv};
use super::cpu::{Frames, add, derived, frames, numbers, sum, total};
use super::norm::{Norm, Sums};
use crate::dropout::Mask;
use candle_core::{Result, Tensor};

pub(crate) struct Layer<'a> {
    pub(crate) conv: Conv,
    pub(crate) transposed: bool,
    /// `[kernel rows * kernel cols * large channels, small channels]`.
    pub(crate) weights: Tensor,
    pub(crate) bias: Option<&'a Tensor>,
    /// Gamma and beta; `None` for the encoder's first layer.
    pub(crate) norm: Option<[&'a Tensor; 2]>,
    pub(crate) output: &'a Mask,
}

pub(super) struct Stage {
    conv: Conv,
    transposed: bool,
    weights: Tensor,
    has_bias: bool,
    pub(super) before: Activation,
    output: Mask,
    /// The bias plus the convolution of the floors, `[channels, cells]`: the initial value of every frame's result.
    start: Vec<f32>,
}

pub(super) struct Gradients {
    buffers: Buffers,
    plane: Vec<f32>,
    d_out: Vec<f32>,
    dx: Vec<f32>,
    weights: Vec<f32>,
    start: Vec<f32>,
    sums: Sums,
}

impl Stage {
    pub(super) fn new(layer: &Layer<'_>, before: Activation) -> Result<Self> {
        let mut stage = Self {
            conv: layer.conv.clone(),
            transposed: layer.transposed,
            weights: layer.weights.clone(),
            has_bias: layer.bias.is_some(),
            before,
            output: layer.output.clone(),
            start: Vec::new(),
        };
        let [_, area] = stage.areas();
        let mut start = vec![0.0; stage.output.channels() * area];
        if let Some(bias) = layer.bias {
            let bias = numbers(bias)?;
            let planes = start.chunks_exact_mut(area).zip(bias.iter());
            planes.for_each(|(plane, bias)| plane.fill(*bias));
        }
        if !stage.before.mask.keeps_all() {
            let mut buffers = stage.conv.buffers();
            stage.put_floors(&mut buffers);
            let (weights, [inputs, outputs]) = (numbers(&stage.weights)?, stage.all_channels());
            stage.convolve(&weights, &mut buffers, &inputs, &outputs, &mut start);
        }
        stage.start = start;
        Ok(stage)
    }

    pub(super) fn areas(&self) -> [usize; 2] {
        let (large, small) = (self.conv.large_area(), self.conv.small_area());
        if self.transposed {
            [small, large]
        } else {
            [large, small]
        }
    }

    fn all_channels(&self) -> [Vec<usize>; 2] {
        let [large, small] = self.conv.channels();
        if self.transposed {
            [small, large]
        } else {
            [large, small]
        }
    }

    #[inline(always)]
    fn put(&self, buffers: &mut Buffers, index: usize, plane: &[f32]) {
        if self.transposed {
            self.conv.put_small(buffers, index, plane);
        } else {
            self.conv.put_large(buffers, index, plane);
        }
    }

    fn put_floors(&self, buffers: &mut Buffers) {
        let mut plane = vec![0.0; self.areas()[0]];
        for (channel, floor) in self.before.floors.iter().enumerate() {
            plane.fill(*floor);
            self.put(buffers, channel, &plane);
            if self.transposed {
                self.conv.transpose_small(buffers, channel, &plane);
            }
        }
    }

    #[inline(always)]
    fn convolve(
        &self,
        weights: &[f32],
        buffers: &mut Buffers,
        inputs: &[usize],
        outputs: &[usize],
        out: &mut [f32],
    ) {
        if self.transposed {
            self.conv.up(weights, buffers, [outputs, inputs], out);
        } else {
            self.conv.down(weights, buffers, [inputs, outputs], out);
        }
    }

    #[inline(always)]
    fn read(
        &self,
        (z, frame): (&Frames, usize),
        (plane, buffers): (&mut [f32], &mut Buffers),
        put: impl Fn(&mut Buffers, usize, usize, &[f32]),
    ) {
        let planes = z.frame(frame).chunks_exact(plane.len());
        let kept = self.before.mask.kept(frame).iter();
        for (index, (channel, z)) in kept.zip(planes).enumerate() {
            self.before.apply(*channel, z, plane);
            put(buffers, index, *channel, plane);
        }
    }

    /// `order` is the order of ReLU and the next normalisation.
    pub(super) fn forward(&self, z: &Frames, order: Order) -> Result<(Frames, Sums)> {
        let (weights, [in_area, area]) = (numbers(&self.weights)?, self.areas());
        let weights = &weights[..];
        let (out, sums) = frames(
            self.output.n_frames(),
            |frame| self.output.kept(frame).len() * area,
            || {
                let sums = Sums::new(self.output.channels());
                (self.conv.buffers(), vec![0.0; in_area], sums)
            },
            #[inline(always)]
            |(buffers, plane, sums), frame, out| {
                self.read(
                    (z, frame),
                    (plane, buffers),
                    #[inline(always)]
                    |buffers, index, _, plane| self.put(buffers, index, plane),
                );
                let (inputs, outputs) = (self.before.mask.kept(frame), self.output.kept(frame));
                for (channel, out) in outputs.iter().zip(out.chunks_exact_mut(area)) {
                    out.copy_from_slice(&self.start[channel * area..][..area]);
                }
                self.convolve(weights, buffers, inputs, outputs, out);
                for (channel, out) in outputs.iter().zip(out.chunks_exact(area)) {
                    order.add_moments(sums, *channel, out);
                }
            },
        );
        let sums: Vec<Sums> = sums.into_iter().map(|(_, _, sums)| sums).collect();
        Ok((out, Sums::total(&sums)))
    }

    pub(super) fn backward(
        &self,
        z: &Frames,
        gradient: &ResultGradient<'_>,
    ) -> Result<(Frames, Vec<Gradients>)> {
        let (weights, [in_area, area]) = (numbers(&self.weights)?, self.areas());
        let (weights, before) = (&weights[..], &self.before);
        let n = |frame: usize| before.norm.as_ref().map_or(0, |_| z.frame(frame).len());
        Ok(frames(
            self.output.n_frames(),
            n,
            || self.gradient_buffers(),
            #[inline(always)]
            |to, frame, dy| {
                let (inputs, outputs) = (before.mask.kept(frame), self.output.kept(frame));
                let d_out = &mut to.d_out[..outputs.len() * area];
                gradient.write(frame, d_out);
                for (output, d) in outputs.iter().zip(d_out.chunks_exact(area)) {
                    add(&mut to.start[output * area..][..area], d);
                }
                if self.transposed && inputs.len() < before.mask.channels() {
                    self.conv.clear_transposed(&mut to.buffers);
                }
                self.read(
                    (z, frame),
                    (&mut to.plane, &mut to.buffers),
                    #[inline(always)]
                    |buffers, index, channel, plane| {
                        self.put_for_gradient(buffers, [index, channel], plane);
                    },
                );
                self.add_gradients(weights, to, inputs, outputs);
                let Some(norm) = &before.norm else {
                    return;
                };
                let planes = z.frame(frame).chunks_exact(in_area);
                let planes = planes.zip(to.dx.chunks_exact(in_area));
                let planes = planes.zip(dy.chunks_exact_mut(in_area));
                for (channel, ((z, dx), dy)) in inputs.iter().zip(planes) {
                    before.backward(norm, *channel, [z, dx], (dy, &mut to.sums));
                }
            },
        ))
    }

    fn gradient_buffers(&self) -> Gradients {
        let ([in_area, area], [inputs, outputs]) = (self.areas(), self.all_channels());
        Gradients {
            buffers: self.conv.buffers(),
            plane: vec![0.0; in_area],
            d_out: vec![0.0; outputs.len() * area],
            dx: vec![0.0; inputs.len() * in_area],
            weights: vec![0.0; self.conv.n_weights()],
            start: vec![0.0; self.start.len()],
            sums: Sums::new(inputs.len()),
        }
    }

    #[inline(always)]
    fn put_for_gradient(&self, buffers: &mut Buffers, [index, channel]: [usize; 2], plane: &[f32]) {
        if self.transposed {
            self.conv.transpose_small(buffers, channel, plane);
        } else {
            self.conv.put_large(buffers, index, plane);
        }
    }

    #[inline(always)]
    fn add_gradients(
        &self,
        weights: &[f32],
        to: &mut Gradients,
        inputs: &[usize],
        outputs: &[usize],
    ) {
        let (conv, buffers, [in_area, area]) = (&self.conv, &mut to.buffers, self.areas());
        let dx = &mut to.dx[..inputs.len() * in_area];
        dx.fill(0.0);
        let planes = to.d_out.chunks_exact(area).take(outputs.len());
        if self.transposed {
            for (index, plane) in planes.enumerate() {
                conv.put_large(buffers, index, plane);
            }
            conv.add_weight_gradient(buffers, outputs, &mut to.weights);
            conv.down(weights, buffers, [outputs, inputs], dx);
            return;
        }
        if outputs.len() < self.output.channels() {
            conv.clear_transposed(buffers);
        }
        for (index, (channel, plane)) in outputs.iter().zip(planes).enumerate() {
            conv.put_small(buffers, index, plane);
            conv.transpose_small(buffers, *channel, plane);
        }
        conv.add_weight_gradient(buffers, inputs, &mut to.weights);
        if self.before.norm.is_some() {
            conv.up(weights, buffers, [inputs, outputs], dx);
        }
    }

    /// Returns the layer's gradients (gamma, beta, weights, bias), and for each input channel the coefficients
    /// `[p, q, r]` of `dz = p dy + q z + r`.
    pub(super) fn finish(&self, chunks: Vec<Gradients>) -> Result<(Vec<f32>, Vec<[f32; 3]>)> {
        let (mut weights, mut starts, mut sums) = (vec![], vec![], vec![]);
        for chunk in chunks {
            weights.push(chunk.weights);
            starts.push(chunk.start);
            sums.push(chunk.sums);
        }
        let (mut weights, start, mut sums) = (total(weights), total(starts), Sums::total(&sums));
        let (mut part, mut terms) = (Vec::new(), Vec::new());
        if let Some(norm) = &self.before.norm {
            if !self.before.mask.keeps_all() {
                self.add_gradients_of_floors(norm, &start, &mut weights, &mut sums)?;
            }
            let gradient = norm.backward(&sums);
            terms = gradient.terms;
            part.extend(gradient.gamma);
            part.extend(gradient.beta);
        }
        part.extend(weights);
        if self.has_bias {
            part.extend(start.chunks_exact(self.areas()[1]).map(sum));
        }
        Ok((part, terms))
    }

    /// Adds the gradients of the convolution of the floors. `start` is the gradient of the results, summed over frames.
    fn add_gradients_of_floors(
        &self,
        norm: &Norm,
        start: &[f32],
        weights: &mut Vec<f32>,
        sums: &mut Sums,
    ) -> Result<()> {
        let (mut to, [inputs, outputs]) = (self.gradient_buffers(), self.all_channels());
        self.put_floors(&mut to.buffers);
        to.d_out.copy_from_slice(start);
        std::mem::swap(&mut to.weights, weights);
        self.add_gradients(&numbers(&self.weights)?, &mut to, &inputs, &outputs);
        std::mem::swap(&mut to.weights, weights);
        for (channel, dx) in to.dx.chunks_exact(self.areas()[0]).enumerate() {
            let lost = sums.lost[channel] + f64::from(sum(dx));
            let passes = self.before.order == Order::ReluFirst || norm.b[channel] > 0.0;
            sums.lost[channel] = if passes { lost } else { 0.0 };
        }
        Ok(())
    }
}

impl Layer<'_> {
    /// Reorders candle's weights, `[small channels, large channels, rows, cols]`, for [`Self::weights`].
    pub(crate) fn weights_of(weights: &Tensor) -> Result<Tensor> {
        let (small, large, rows, cols) = weights.dims4()?;
        let taps = rows * cols;
        let ours = permuted(&numbers(weights)?, [small, large, taps]);
        derived(&[weights], (taps * large, small), ours, move |d| {
            permuted(d, [taps, large, small])
        })
    }

    /// Returns gamma, beta, weights and bias, if the layer has them, in the order of [`Stage::finish`].
    pub(crate) fn tensors(&self) -> Vec<&Tensor> {
        let norm = self.norm.into_iter().flatten();
        norm.chain([&self.weights]).chain(self.bias).collect()
    }

    pub(super) fn in_area(&self) -> usize {
        if self.transposed {
            self.conv.small_area()
        } else {
            self.conv.large_area()
        }
    }
}

fn permuted(numbers: &[f32], [a, b, c]: [usize; 3]) -> Vec<f32> {
    // Rows of `to` are often a power of two apart and would evict each other from the cache, so copy through a tile.
    let (mut to, mut tile) = (vec![0.0; numbers.len()], vec![0.0; a * c]);
    for at_b in 0..b {
        for at_a in 0..a {
            let from = &numbers[(at_a * b + at_b) * c..][..c];
            for (at_c, number) in from.iter().enumerate() {
                tile[at_c * a + at_a] = *number;
            }
        }
        for (at_c, row) in tile.chunks_exact(a).enumerate() {
            to[(at_c * b + at_b) * a..][..a].copy_from_slice(row);
        }
    }
    to
}
