//! The encoder's convolutions as one operator, each with dropout, ReLU and normalisation behind it.
//!
//! Between the passes over all frames, only the convolutions' results are kept; what is cheap is computed again.

use super::conv::Conv;
use super::cpu::{Frames, add, derived, frames, numbers, total};
use super::norm::{Moments, Norm, Sums};
use super::visited_conv::VisitedConv;
use crate::dropout::Mask;
use crate::shape::ConvShape;
use crate::window::Window;
use candle_core::{Device, Result, Tensor};

/// Positions whose sum is kept in 32 bits. A variance is a difference of two sums, so longer ones lose digits.
const ROWS: usize = 16;

/// Arguments of one convolution.
pub(crate) struct Layer<'a> {
    pub(crate) shape: ConvShape,
    /// `[kernel rows * kernel cols * channels in, channels out]`; of the first the channels in come first.
    pub(crate) kernels: Tensor,
    pub(crate) bias: &'a Tensor,
    /// Gamma and beta.
    pub(crate) norm: [&'a Tensor; 2],
    pub(crate) mask: &'a Mask,
}

struct Stage {
    shape: ConvShape,
    kernels: Vec<f32>,
    mask: Mask,
    norm: Norm,
    /// The convolution's results `[positions, channels]`.
    z: Frames,
}

struct Encoder {
    window: Window,
    stages: Vec<Stage>,
}

/// Sums of the backward pass, and room for one frame.
struct Gradients {
    kernels: Vec<f32>,
    bias: Vec<f32>,
    /// Of the stage before.
    sums: Sums,
    dz: Vec<f32>,
    x: Vec<f32>,
}

/// Features `[frames, channels * positions]`. `moments` gives those of a layer from those of the window. Without
/// `trains` no gradient goes through.
pub(crate) fn encode(
    window: &Window,
    layers: &[Layer<'_>],
    trains: bool,
    mut moments: impl FnMut(usize, Moments) -> Result<Moments>,
) -> Result<Tensor> {
    let mut encoder = Encoder {
        window: window.clone(),
        stages: Vec::new(),
    };
    for (index, layer) in layers.iter().enumerate() {
        let kernels = numbers(&layer.kernels)?.to_vec();
        let (z, sums) = encoder.convolve(layer, &kernels, &numbers(layer.bias)?);
        let [rows, cols] = layer.shape.output;
        let moments = moments(index, Moments::new(&sums, 1.0, window.len() * rows * cols))?;
        let [gamma, beta] = layer.norm;
        encoder.stages.push(Stage {
            shape: layer.shape,
            kernels,
            mask: layer.mask.clone(),
            norm: Norm::new([&numbers(gamma)?, &numbers(beta)?], moments, 1.0),
            z,
        });
    }
    let features = encoder.features();
    let dims = (window.len(), features.len() / window.len());
    if !trains {
        return Tensor::from_vec(features, dims, &Device::Cpu);
    }
    let from = layers
        .iter()
        .flat_map(|layer| [&layer.kernels, layer.bias, layer.norm[0], layer.norm[1]]);
    derived(&from.collect::<Vec<_>>(), dims, features, move |d| {
        encoder.backward(d)
    })
}

impl Encoder {
    /// The next convolution's results, and its sums.
    fn convolve(&self, layer: &Layer<'_>, kernels: &[f32], bias: &[f32]) -> (Frames, Sums) {
        let (shape, channels) = (&layer.shape, layer.shape.channels_out);
        let per_frame = shape.output[0] * shape.output[1] * channels;
        let (first, conv) = (VisitedConv(*shape), Conv::new(shape, kernels));
        let (z, chunks) = frames(
            self.window.len(),
            |_| per_frame,
            || (Sums::new(channels), vec![0.0; self.last_length()]),
            #[inline(always)]
            |(sums, x), frame, z| {
                let places = z.chunks_exact_mut(channels);
                places.for_each(|z| z.copy_from_slice(bias));
                match self.stages.last() {
                    None => first.forward(self.window.visits(frame), kernels, z),
                    Some(before) => {
                        before.normalise(frame, x);
                        conv.forward(x, z);
                    }
                }
                add_sums(
                    sums,
                    z,
                    layer.mask.scales(frame),
                    #[inline(always)]
                    |_, m| [m, m * m],
                );
            },
        );
        let sums: Vec<Sums> = chunks.into_iter().map(|(sums, _)| sums).collect();
        (z, Sums::total(&sums))
    }

    /// Numbers of a frame of the last stage so far.
    fn last_length(&self) -> usize {
        self.stages.last().map_or(0, Stage::length)
    }

    /// What comes out of the last normalisation, channel by channel.
    fn features(&self) -> Vec<f32> {
        let last = self.stages.last().expect("invariant: three stages");
        let (channels, length) = (last.shape.channels_out, last.length());
        let (features, _) = frames(
            self.window.len(),
            |_| length,
            || vec![0.0; length],
            #[inline(always)]
            |y, frame, features| {
                last.normalise(frame, y);
                turn(y, channels, features);
            },
        );
        features.concat()
    }

    /// All gradients one after the other.
    fn backward(&self, d_features: &[f32]) -> Vec<f32> {
        let last = self.stages.last().expect("invariant: three stages");
        let (length, channels) = (last.length(), last.shape.channels_out);
        let (mut dy, sums) = frames(
            self.window.len(),
            |_| length,
            || Sums::new(channels),
            #[inline(always)]
            |sums, frame, dy| {
                let d = &d_features[frame * length..][..length];
                turn(d, length / channels, dy);
                last.add_gradient(frame, dy, sums);
            },
        );
        let (mut sums, mut parts) = (Sums::total(&sums), Vec::new());
        for (index, stage) in self.stages.iter().enumerate().rev() {
            let norm = stage.norm.backward(&sums);
            let (dx, chunks) = self.backward_of(index, &norm.terms, &dy);
            let (mut kernels, mut biases, mut before) = (vec![], vec![], vec![]);
            for chunk in chunks {
                kernels.push(chunk.kernels);
                biases.push(chunk.bias);
                before.push(chunk.sums);
            }
            (dy, sums) = (dx, Sums::total(&before));
            parts.extend([norm.beta, norm.gamma, total(biases), total(kernels)]);
        }
        parts.reverse();
        parts.concat()
    }

    /// Gradients of one convolution, from the one behind its normalisation.
    fn backward_of(
        &self,
        index: usize,
        terms: &[[f32; 3]],
        dy: &Frames,
    ) -> (Frames, Vec<Gradients>) {
        let (stages, stage) = self.stages.split_at(index);
        let (stage, before) = (&stage[0], stages.last());
        let channels = stage.shape.channels_out;
        let length = before.map_or(0, Stage::length);
        let first = VisitedConv(stage.shape);
        let conv = Conv::new(&stage.shape, &stage.kernels);
        let turned = conv.turned();
        frames(
            self.window.len(),
            |_| length,
            || Gradients {
                kernels: vec![0.0; stage.kernels.len()],
                bias: vec![0.0; channels],
                sums: Sums::new(stage.shape.channels_in),
                dz: vec![0.0; stage.length()],
                x: vec![0.0; length],
            },
            #[inline(always)]
            |to, frame, dx| {
                stage.normalise_gradient(frame, terms, dy.frame(frame), &mut to.dz);
                for dz in to.dz.chunks_exact(channels) {
                    add(&mut to.bias, dz);
                }
                let Some(before) = before else {
                    let visits = self.window.visits(frame);
                    return first.backward(visits, &to.dz, &mut to.kernels);
                };
                before.normalise(frame, &mut to.x);
                conv.add_gradient(&to.x, &to.dz, &mut to.kernels);
                conv.backward(&turned, &to.dz, dx);
                before.add_gradient(frame, dx, &mut to.sums);
            },
        )
    }
}

impl Stage {
    /// Numbers of a frame.
    fn length(&self) -> usize {
        self.shape.output[0] * self.shape.output[1] * self.shape.channels_out
    }

    /// A frame behind dropout, ReLU and normalisation.
    #[inline(always)]
    fn normalise(&self, frame: usize, y: &mut [f32]) {
        let (scales, norm) = (self.mask.scales(frame), &self.norm);
        let z = self.z.frame(frame).chunks_exact(scales.len());
        for (y, z) in y.chunks_exact_mut(scales.len()).zip(z) {
            for c in 0..scales.len() {
                y[c] = norm.a[c] * (z[c] * scales[c]).max(0.0) + norm.b[c];
            }
        }
    }

    /// Adds what the normalisation's gradient needs to know of a frame's.
    #[inline(always)]
    fn add_gradient(&self, frame: usize, dy: &[f32], sums: &mut Sums) {
        add_sums(
            sums,
            self.z.frame(frame),
            self.mask.scales(frame),
            #[inline(always)]
            |at, m| [dy[at], dy[at] * m],
        );
    }

    /// A frame's gradient before dropout.
    #[inline(always)]
    fn normalise_gradient(&self, frame: usize, terms: &[[f32; 3]], dy: &[f32], dz: &mut [f32]) {
        let scales = self.mask.scales(frame);
        let channels = scales.len();
        let z = self.z.frame(frame).chunks_exact(channels);
        let dy = dy.chunks_exact(channels);
        for (dz, (z, dy)) in dz.chunks_exact_mut(channels).zip(z.zip(dy)) {
            for c in 0..channels {
                let m = z[c] * scales[c];
                let [p, q, r] = terms[c];
                let d = scales[c] * (p * dy[c] + q * m + r);
                dz[c] = if m > 0.0 { d } else { 0.0 };
            }
        }
    }
}

/// Adds, per channel, the two numbers that `f(place, relu(dropout(z)))` gives, over a frame.
#[inline(always)]
fn add_sums(sums: &mut Sums, z: &[f32], scales: &[f32], f: impl Fn(usize, f32) -> [f32; 2]) {
    let channels = scales.len();
    let (mut s, mut q) = (vec![0.0_f32; channels], vec![0.0_f32; channels]);
    let mut first = 0;
    for rows in z.chunks(ROWS * channels) {
        s.fill(0.0);
        q.fill(0.0);
        for z in rows.chunks_exact(channels) {
            for c in 0..channels {
                let [one, other] = f(first + c, (z[c] * scales[c]).max(0.0));
                s[c] += one;
                q[c] += other;
            }
            first += channels;
        }
        for c in 0..channels {
            sums.first[c] += f64::from(s[c]);
            sums.with_z[c] += f64::from(q[c]);
        }
    }
}

/// Rows of `n` numbers to columns.
#[inline(always)]
fn turn(rows: &[f32], n: usize, columns: &mut [f32]) {
    let length = rows.len() / n;
    for (row, numbers) in rows.chunks_exact(n).enumerate() {
        for (col, number) in numbers.iter().enumerate() {
            columns[col * length + row] = *number;
        }
    }
}
