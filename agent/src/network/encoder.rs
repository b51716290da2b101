//! The encoder over a window: three convolutions, each followed by Dropout2d, ReLU and batch
//! normalisation, and a linear layer.
//!
//! Batch normalisation needs sums over all frames, so each layer is a pass of its own.

use super::batch_norm::{Norm, NormGradient, Statistics, Sums};
use super::conv::{Dense, DenseGradient, Sparse};
use super::dropout::{ChannelMask, Dropout};
use super::lanes::{Arithmetic, LANES, Lanes};
use super::parallel::{Pass, chunks_of, for_each_chunk};
use super::parameters::{ENCODER, LINEAR, Tensors};
use super::shape::{ConvShape, NetworkShape};
use super::window::Window;
use std::ops::Range;

/// One chunk's frames: their maps, and gradients of everything.
#[derive(Debug)]
pub(crate) struct Chunk {
    frames: Range<usize>,
    /// After ReLU, before normalisation; channels last.
    maps: [Vec<f32>; 3],
    /// Gradients of the normalised maps.
    d_maps: [Vec<f32>; 3],
    encodings: Vec<f32>,
    sums: Sums,
    d_columns: Vec<f32>,
    d_bias: Vec<f32>,
    dense: [DenseGradient; 2],
    linear: LinearGradient,
    /// One frame's gradient before ReLU.
    dz: Vec<f32>,
}

/// The encoder's weights, ready for a window.
#[derive(Debug)]
pub(crate) struct Encoder {
    shapes: [ConvShape; 3],
    encoding: usize,
    chunks: Vec<Chunk>,
}

/// What the backward pass needs beside the chunks.
#[derive(Debug)]
pub(crate) struct EncoderLayers {
    pub(crate) sparse: Sparse,
    pub(crate) dense: [Dense; 2],
    pub(crate) linear: Linear,
    pub(crate) norms: [Norm; 3],
}

impl Encoder {
    /// Room for windows of `n_frames` inputs.
    pub(crate) fn new(shape: &NetworkShape, n_frames: usize) -> Self {
        let shapes = shape.convolutions();
        let chunk = |frames: Range<usize>| {
            let maps = shapes.map(|conv| vec![0.0; frames.len() * conv.outputs()]);
            Chunk {
                d_maps: maps.clone(),
                maps,
                encodings: vec![0.0; frames.len() * shape.encoding],
                sums: Sums::default(),
                d_columns: vec![
                    0.0;
                    shapes[0].channels_out * shapes[0].channels_in * shapes[0].taps()
                ],
                d_bias: vec![0.0; shapes[0].channels_out],
                dense: [
                    DenseGradient::zeros(&shapes[1]),
                    DenseGradient::zeros(&shapes[2]),
                ],
                linear: LinearGradient::zeros(shape.encoding, shapes[2].outputs()),
                dz: Vec::new(),
                frames,
            }
        };
        Self {
            shapes,
            encoding: shape.encoding,
            chunks: chunks_of(n_frames).map(chunk).collect(),
        }
    }

    /// Encodings of all frames, one row each, with the statistics of this window.
    pub(crate) fn forward(
        &mut self,
        parameters: &Tensors,
        window: &Window,
        dropout: &Dropout,
    ) -> (Vec<f32>, EncoderLayers) {
        let shapes = self.shapes;
        let (weight, bias) = parameters.layer(ENCODER[0][0]);
        let sparse = Sparse::new(shapes[0], weight, bias);
        // Most cells of a kept channel see nothing and hold this number.
        let origin: Vec<f32> = bias.iter().map(|b| (b * dropout.scale).max(0.0)).collect();
        let pass = SparseForward {
            sparse: &sparse,
            window,
            dropout,
            origin: &origin,
        };
        for_each_chunk(&mut self.chunks, &pass);
        let first = self.norm(0, parameters, &origin);
        let conv = self.convolve(1, parameters, &first, dropout);
        let second = self.norm(1, parameters, &[0.0; LANES]);
        let last = self.convolve(2, parameters, &second, dropout);
        let third = self.norm(2, parameters, &[0.0; LANES]);
        let linear = Linear::new(shapes[2], self.encoding, parameters, &third);
        for_each_chunk(&mut self.chunks, &LinearForward { linear: &linear });
        let encodings = self.chunks.iter().flat_map(|chunk| &chunk.encodings);
        let layers = EncoderLayers {
            sparse,
            dense: [conv, last],
            linear,
            norms: [first, second, third],
        };
        (encodings.copied().collect(), layers)
    }

    fn convolve(
        &mut self,
        stage: usize,
        parameters: &Tensors,
        input: &Norm,
        dropout: &Dropout,
    ) -> Dense {
        let (weight, bias) = parameters.layer(ENCODER[stage][0]);
        let conv = Dense::new(self.shapes[stage], weight, bias, input);
        for_each_chunk(
            &mut self.chunks,
            &DenseForward {
                stage,
                conv: &conv,
                dropout,
            },
        );
        conv
    }

    fn n_frames(&self) -> usize {
        self.chunks.iter().map(|chunk| chunk.frames.len()).sum()
    }

    /// The normalisation after a stage, whose sums the chunks hold.
    fn norm(&self, stage: usize, parameters: &Tensors, origin: &[f32]) -> Norm {
        let sums = Sums::total(self.chunks.iter().map(|chunk| &chunk.sums));
        let count = (self.n_frames() * self.shapes[stage].positions()) as f64;
        encoder_norm(stage, parameters, Statistics::new(&sums, origin, count))
    }

    /// Gradients of all parameters from those of the encodings.
    pub(crate) fn backward(
        &mut self,
        layers: &EncoderLayers,
        window: &Window,
        dropout: &Dropout,
        d_encodings: &[f32],
        gradient: &mut Tensors,
    ) {
        for_each_chunk(
            &mut self.chunks,
            &LinearBackward {
                linear: &layers.linear,
                d_encodings,
            },
        );
        self.write_linear(&layers.linear, gradient);
        for stage in [2, 1] {
            let norm = self.norm_gradient(stage, layers, gradient);
            let conv = &layers.dense[stage - 1];
            for_each_chunk(
                &mut self.chunks,
                &DenseBackward {
                    stage,
                    conv,
                    norm: &norm,
                    dropout,
                },
            );
            let mut total = DenseGradient::zeros(&self.shapes[stage]);
            for chunk in &self.chunks {
                total.add(&chunk.dense[stage - 1]);
            }
            let (weight, bias) = conv.unfold(&total);
            gradient.set_layer(ENCODER[stage][0], &weight, &bias);
        }
        let norm = self.norm_gradient(0, layers, gradient);
        let pass = SparseBackward {
            sparse: &layers.sparse,
            window,
            norm: &norm,
            dropout,
        };
        for_each_chunk(&mut self.chunks, &pass);
        let d_columns = total(self.chunks.iter().map(|chunk| &chunk.d_columns[..]));
        let d_bias = total(self.chunks.iter().map(|chunk| &chunk.d_bias[..]));
        let weight = layers.sparse.weight_gradient(&d_columns);
        gradient.set_layer(ENCODER[0][0], &weight, &d_bias);
    }

    fn norm_gradient(
        &self,
        stage: usize,
        layers: &EncoderLayers,
        gradient: &mut Tensors,
    ) -> NormGradient {
        let sums = Sums::total(self.chunks.iter().map(|chunk| &chunk.sums));
        let norm = layers.norms[stage].gradient(&sums);
        let channels = self.shapes[stage].channels_out;
        gradient.set_layer(
            ENCODER[stage][1],
            &norm.weight[..channels],
            &norm.bias[..channels],
        );
        norm
    }

    fn write_linear(&self, linear: &Linear, gradient: &mut Tensors) {
        let weight = total(self.chunks.iter().map(|chunk| &chunk.linear.weight[..]));
        let bias = total(self.chunks.iter().map(|chunk| &chunk.linear.bias[..]));
        gradient.set_layer(LINEAR, &linear.flattened(&weight), &bias);
    }
}

/// The sum of equally long vectors.
pub(crate) fn total<'a>(parts: impl Iterator<Item = &'a [f32]>) -> Vec<f32> {
    let mut total = Vec::new();
    for part in parts {
        total.resize(part.len(), 0.0);
        for (sum, x) in total.iter_mut().zip(part) {
            *sum += x;
        }
    }
    total
}

/// A stage's normalisation, padded to whole lanes with zeros.
pub(crate) fn encoder_norm(stage: usize, parameters: &Tensors, mut statistics: Statistics) -> Norm {
    let (weight, bias) = parameters.layer(ENCODER[stage][1]);
    let channels = weight.len().next_multiple_of(LANES);
    let padded = |numbers: &[f32]| {
        let mut numbers = numbers.to_vec();
        numbers.resize(channels, 0.0);
        numbers
    };
    statistics.mean.resize(channels, 0.0);
    statistics.variance.resize(channels, 0.0);
    Norm::new(statistics, &padded(weight), &padded(bias))
}

/// What each channel of a frame is multiplied with, in whole lanes.
#[inline(always)]
fn multipliers(mask: &ChannelMask, frame: usize, scale: f32) -> [f32; 2 * LANES] {
    let mut multipliers = [0.0; 2 * LANES];
    for &channel in mask.kept(frame) {
        multipliers[usize::from(channel) % (2 * LANES)] = scale;
    }
    multipliers
}

/// Adds to each channel's sums over one frame's positions of `x - origin` and `(x - origin) y`, where
/// `y` is `x - origin` itself if it is not given.
#[inline(always)]
fn add_sums<A: Arithmetic>(x: &[f32], y: Option<&[f32]>, origin: &[f32], sums: &mut Sums) {
    let channels = origin.len();
    for first in (0..channels).step_by(LANES) {
        let (mut sum, mut product) = (Lanes::ZERO, Lanes::ZERO);
        let minus = Lanes(Lanes::load(&origin[first..]).0.map(|value| -value));
        for position in (first..x.len()).step_by(channels) {
            let x = Lanes::load(&x[position..]).add::<A>(minus);
            let y = y.map_or(x, |y| Lanes::load(&y[position..]));
            sum = sum.add::<A>(x);
            product = product.add_product::<A>(x, y);
        }
        for lane in 0..LANES {
            sums.add(first + lane, (sum.0[lane], product.0[lane]));
        }
    }
}

struct SparseForward<'a> {
    sparse: &'a Sparse,
    window: &'a Window,
    dropout: &'a Dropout,
    origin: &'a [f32],
}

impl Pass<Chunk> for SparseForward<'_> {
    #[inline(always)]
    fn run<A: Arithmetic>(&self, chunk: &mut Chunk) {
        chunk.sums = Sums::zeros(self.origin.len());
        let n_maps = chunk.frames.len();
        let length = chunk.maps[0].len() / n_maps.max(1);
        for (frame, map) in chunk
            .frames
            .clone()
            .zip(chunk.maps[0].chunks_exact_mut(length.max(1)))
        {
            let mask = multipliers(&self.dropout.encoder[0], frame, self.dropout.scale);
            self.sparse
                .forward::<A>(self.window.visits(frame), &mask, map);
            add_sums::<A>(map, None, self.origin, &mut chunk.sums);
        }
    }
}

struct DenseForward<'a> {
    stage: usize,
    conv: &'a Dense,
    dropout: &'a Dropout,
}

impl Pass<Chunk> for DenseForward<'_> {
    #[inline(always)]
    fn run<A: Arithmetic>(&self, chunk: &mut Chunk) {
        chunk.sums = Sums::zeros(LANES);
        let n_frames = chunk.frames.len().max(1);
        let (before, after) = chunk.maps.split_at_mut(self.stage);
        let (input, output) = (&before[self.stage - 1], &mut after[0]);
        let inputs = input.chunks_exact((input.len() / n_frames).max(1));
        let outputs = output.len() / n_frames;
        for ((frame, input), output) in chunk
            .frames
            .clone()
            .zip(inputs)
            .zip(output.chunks_exact_mut(outputs.max(1)))
        {
            let mask = multipliers(&self.dropout.encoder[self.stage], frame, self.dropout.scale);
            let kept = self.dropout.encoder[self.stage - 1].kept(frame);
            self.conv.forward::<A>(input, kept, &mask, output);
            add_sums::<A>(output, None, &[0.0; LANES], &mut chunk.sums);
        }
    }
}

/// `dz` of a frame: back through normalisation, ReLU and dropout.
#[inline(always)]
fn before_relu<A: Arithmetic>(
    d_map: &[f32],
    map: &[f32],
    norm: &NormGradient,
    mask: &[f32],
    dz: &mut [f32],
) {
    let lanes = |numbers: &[f32], group: usize| Lanes::load(&numbers[group * LANES..]).0;
    let n_groups = norm.constant.len() / LANES;
    let groups = map
        .as_chunks::<LANES>()
        .0
        .iter()
        .zip(d_map.as_chunks::<LANES>().0);
    for (index, ((map, d_map), dz)) in groups.zip(dz.as_chunks_mut::<LANES>().0).enumerate() {
        let group = index % n_groups;
        let [dy_factor, u_factor] = [&norm.dy_factor, &norm.u_factor].map(|f| lanes(f, group));
        let [constant, mask] = [&norm.constant[..], mask].map(|numbers| lanes(numbers, group));
        let du = Lanes(constant)
            .add_product::<A>(Lanes(*map), Lanes(u_factor))
            .add_product::<A>(Lanes(*d_map), Lanes(dy_factor));
        for lane in 0..LANES {
            let factor = if map[lane] > 0.0 { mask[lane] } else { 0.0 };
            dz[lane] = du.0[lane] * factor;
        }
    }
}

struct DenseBackward<'a> {
    stage: usize,
    conv: &'a Dense,
    norm: &'a NormGradient,
    dropout: &'a Dropout,
}

impl Pass<Chunk> for DenseBackward<'_> {
    #[inline(always)]
    fn run<A: Arithmetic>(&self, chunk: &mut Chunk) {
        let n_frames = chunk.frames.len().max(1);
        let gradient = &mut chunk.dense[self.stage - 1];
        gradient.clear();
        let length = chunk.maps[self.stage].len() / n_frames;
        let length_in = chunk.maps[self.stage - 1].len() / n_frames;
        chunk.sums = Sums::zeros(self.conv.inputs());
        let origin = [0.0; 2 * LANES];
        chunk.dz.resize(length, 0.0);
        for (index, frame) in chunk.frames.clone().enumerate() {
            let mask = &self.dropout.encoder[self.stage];
            let factors = multipliers(mask, frame, self.dropout.scale);
            let at = index * length..(index + 1) * length;
            let (map, d_map) = (
                &chunk.maps[self.stage][at.clone()],
                &chunk.d_maps[self.stage][at],
            );
            before_relu::<A>(d_map, map, self.norm, &factors, &mut chunk.dz);
            let at = index * length_in..(index + 1) * length_in;
            let input = &chunk.maps[self.stage - 1][at.clone()];
            let dx = &mut chunk.d_maps[self.stage - 1][at];
            self.conv
                .backward::<A>(input, mask.kept(frame), &chunk.dz, dx, gradient);
            add_sums::<A>(
                dx,
                Some(input),
                &origin[..chunk.sums.first.len()],
                &mut chunk.sums,
            );
        }
    }
}

struct SparseBackward<'a> {
    sparse: &'a Sparse,
    window: &'a Window,
    norm: &'a NormGradient,
    dropout: &'a Dropout,
}

impl Pass<Chunk> for SparseBackward<'_> {
    #[inline(always)]
    fn run<A: Arithmetic>(&self, chunk: &mut Chunk) {
        chunk.d_columns.fill(0.0);
        chunk.d_bias.fill(0.0);
        let length = chunk.maps[0].len() / chunk.frames.len().max(1);
        chunk.dz.resize(length, 0.0);
        for (index, frame) in chunk.frames.clone().enumerate() {
            let mask = multipliers(&self.dropout.encoder[0], frame, self.dropout.scale);
            let at = index * length..(index + 1) * length;
            let (map, d_map) = (&chunk.maps[0][at.clone()], &chunk.d_maps[0][at]);
            before_relu::<A>(d_map, map, self.norm, &mask, &mut chunk.dz[..length]);
            let (d_columns, d_bias) = (&mut chunk.d_columns, &mut chunk.d_bias);
            let visits = self.window.visits(frame);
            self.sparse
                .backward::<A>(visits, &chunk.dz[..length], d_columns, d_bias);
        }
    }
}

/// The linear layer from the normalised, flattened last map to the encoding.
#[derive(Debug)]
pub(crate) struct Linear {
    shape: ConvShape,
    /// `[encoding][position][channel]`, channels padded to whole lanes.
    weight: Vec<f32>,
    bias: Vec<f32>,
    input: Norm,
}

#[derive(Debug)]
struct LinearGradient {
    weight: Vec<f32>,
    bias: Vec<f32>,
    /// One frame's input.
    x: Vec<f32>,
}

impl LinearGradient {
    fn zeros(encoding: usize, length: usize) -> Self {
        Self {
            weight: vec![0.0; encoding * length],
            bias: vec![0.0; encoding],
            x: vec![0.0; length],
        }
    }
}

impl Linear {
    pub(crate) fn new(
        shape: ConvShape,
        encoding: usize,
        parameters: &Tensors,
        input: &Norm,
    ) -> Self {
        let (weight, bias) = parameters.layer(LINEAR);
        let mut linear = Self {
            shape,
            weight: vec![0.0; encoding * shape.outputs()],
            bias: bias.to_vec(),
            input: input.clone(),
        };
        for (index, entry) in weight.iter().enumerate() {
            let at = linear.place(index);
            linear.weight[at] = *entry;
        }
        linear
    }

    /// Where PyTorch's entry `[encoding][channel][position]` is.
    fn place(&self, index: usize) -> usize {
        let (channels, positions) = (self.shape.channels_out, self.shape.positions());
        let (row, channel, position) = (
            index / (channels * positions),
            index / positions % channels,
            index % positions,
        );
        (row * positions + position) * self.shape.lanes_out() + channel
    }

    /// Gradients in PyTorch's layout.
    fn flattened(&self, weight: &[f32]) -> Vec<f32> {
        let rows = self.bias.len() * self.shape.channels_out * self.shape.positions();
        (0..rows).map(|index| weight[self.place(index)]).collect()
    }

    /// The normalised map.
    #[inline(always)]
    fn input<A: Arithmetic>(&self, map: &[f32], x: &mut [f32]) {
        let (scale, shift) = (
            Lanes::load(&self.input.scale),
            Lanes::load(&self.input.shift),
        );
        for (map, x) in map.as_chunks().0.iter().zip(x.as_chunks_mut().0) {
            *x = shift.add_product::<A>(Lanes(*map), scale).0;
        }
    }

    /// One frame's encoding; `x` is room for the normalised map.
    #[inline(always)]
    pub(crate) fn forward<A: Arithmetic>(&self, map: &[f32], x: &mut [f32], encoding: &mut [f32]) {
        self.input::<A>(map, x);
        let rows = self.weight.chunks_exact(x.len());
        for ((encoding, bias), row) in encoding.iter_mut().zip(&self.bias).zip(rows) {
            *encoding = bias + super::lanes::sum_and_product::<A>(x, row).1;
        }
    }

    #[inline(always)]
    fn backward<A: Arithmetic>(
        &self,
        map: &[f32],
        d: &[f32],
        dx: &mut [f32],
        gradient: &mut LinearGradient,
    ) {
        self.input::<A>(map, &mut gradient.x);
        dx.fill(0.0);
        let length = dx.len();
        for (row, d) in d.iter().enumerate() {
            gradient.bias[row] += d;
            let weight = &self.weight[row * length..][..length];
            let d_weight = &mut gradient.weight[row * length..][..length];
            for at in 0..length {
                dx[at] = A::mul_add(*d, weight[at], dx[at]);
                d_weight[at] = A::mul_add(*d, gradient.x[at], d_weight[at]);
            }
        }
    }
}

struct LinearForward<'a> {
    linear: &'a Linear,
}

impl Pass<Chunk> for LinearForward<'_> {
    #[inline(always)]
    fn run<A: Arithmetic>(&self, chunk: &mut Chunk) {
        let maps = chunk.maps[2].chunks_exact(self.linear.shape.outputs());
        let encodings = chunk.encodings.chunks_exact_mut(self.linear.bias.len());
        for (map, encoding) in maps.zip(encodings) {
            self.linear.forward::<A>(map, &mut chunk.linear.x, encoding);
        }
    }
}

struct LinearBackward<'a> {
    linear: &'a Linear,
    d_encodings: &'a [f32],
}

impl Pass<Chunk> for LinearBackward<'_> {
    #[inline(always)]
    fn run<A: Arithmetic>(&self, chunk: &mut Chunk) {
        chunk.sums = Sums::zeros(LANES);
        chunk.linear.weight.fill(0.0);
        chunk.linear.bias.fill(0.0);
        let (length, encoding) = (self.linear.shape.outputs(), self.linear.bias.len());
        for (index, frame) in chunk.frames.clone().enumerate() {
            let at = index * length..(index + 1) * length;
            let (map, dx) = (&chunk.maps[2][at.clone()], &mut chunk.d_maps[2][at]);
            let d = &self.d_encodings[frame * encoding..][..encoding];
            self.linear.backward::<A>(map, d, dx, &mut chunk.linear);
            add_sums::<A>(dx, Some(map), &[0.0; LANES], &mut chunk.sums);
        }
    }
}
