//! The decoder over a window: a seed, doubled four times, with Dropout2d, batch normalisation and ReLU
//! between; and the loss behind it.
//!
//! `u` are maps after dropout, before normalisation, of the kept channels only: one plane each, in the
//! order of [`ChannelMask::kept`].

use super::batch_norm::{Norm, NormGradient, Statistics, Sums};
use super::correlation::Kernel4x4;
use super::deconv::{Doubling, Scratch};
use super::dropout::{ChannelMask, Dropout};
use super::encoder::total;
use super::lanes::{Arithmetic, LANES, Lanes, Portable, sum_and_product};
use super::loss::CellLoss;
use super::parallel::{Pass, chunks_of, for_each_chunk};
use super::parameters::{DECODER, DECODER_NORMS, OBSERVATION, Tensors};
use super::seed::Seed;
use super::shape::{DECODER_CHANNELS, NetworkShape};
use super::visited::{LastLayer, LastMaps};
use super::window::Window;
use protocol::frame::UNOBSERVED;
use std::ops::Range;

const LEVELS: usize = DECODER_CHANNELS.len();

/// From this share of visited cells on, one in so many, all cells are decoded.
const DENSE_FROM: usize = 12;

/// One chunk's frames: their maps, and gradients of everything.
#[derive(Debug)]
pub(crate) struct Chunk {
    frames: Range<usize>,
    u: [Vec<f32>; LEVELS],
    /// Gradients of the normalised maps, before ReLU.
    dy: [Vec<f32>; LEVELS],
    sums: Sums,
    scratch: [Scratch; LEVELS],
    d_seed: Vec<f32>,
    d_weights: [Vec<Kernel4x4>; LEVELS],
    /// Per output channel of each doubling, over all frames.
    patch_sums: [Vec<Lanes>; LEVELS],
    /// Of the last doubling, where it was evaluated at visited cells only.
    d_last: Vec<Lanes>,
    d_hidden: Vec<f32>,
    loss: CellLoss,
    /// One frame's logits, then their gradients, and its observations; all cells.
    logits: Vec<f32>,
    values: Vec<u8>,
    /// One plane.
    dz: Vec<f32>,
}

/// Room for a window.
#[derive(Debug)]
pub(crate) struct Decoder {
    shape: NetworkShape,
    chunks: Vec<Chunk>,
}

/// The decoder's weights and normalisations, ready for a window.
#[derive(Debug)]
pub(crate) struct DecoderLayers {
    pub(crate) seed: Seed,
    pub(crate) doublings: [Doubling; LEVELS],
    pub(crate) norms: Vec<Norm>,
}

impl DecoderLayers {
    /// Without normalisations yet.
    pub(crate) fn new(shape: &NetworkShape, parameters: &Tensors) -> Self {
        let weight = |level: usize| parameters.get(&format!("{}.weight", DECODER[level]));
        let cells = shape.seed().iter().product();
        Self {
            seed: Seed::new(shape.hidden, DECODER_CHANNELS[0], cells, weight(0)),
            doublings: std::array::from_fn(|level| {
                let channels = shape.doubling_channels(level);
                Doubling::new(shape.doubled(level), channels, weight(level + 1))
            }),
            norms: Vec::with_capacity(LEVELS),
        }
    }

    /// What dropout leaves of each channel that it takes before a doubling.
    fn floors(&self, level: usize) -> Vec<f32> {
        let channels = 0..DECODER_CHANNELS[level];
        channels
            .map(|channel| self.norms[level].floor(channel))
            .collect()
    }
}

/// What a doubling does to each frame of a window.
struct Level<'a> {
    level: usize,
    layers: &'a DecoderLayers,
    dropout: &'a Dropout,
    floors: Vec<f32>,
    constants: Vec<f32>,
}

impl<'a> Level<'a> {
    fn new(level: usize, layers: &'a DecoderLayers, dropout: &'a Dropout) -> Self {
        let floors = layers.floors(level);
        Self {
            level,
            layers,
            dropout,
            constants: layers.doublings[level].constant_map(&floors),
            floors,
        }
    }

    fn doubling(&self) -> &Doubling {
        &self.layers.doublings[self.level]
    }

    fn norm(&self) -> &Norm {
        &self.layers.norms[self.level]
    }

    fn mask(&self) -> &ChannelMask {
        &self.dropout.decoder[self.level]
    }

    /// Numbers per frame of the maps before.
    fn length_in(&self) -> usize {
        self.doubling().channels_in * self.doubling().plane_in()
    }

    /// Numbers per frame of the maps after.
    fn length_out(&self) -> usize {
        self.doubling().channels_out * self.doubling().plane_out()
    }
}

impl Decoder {
    /// Room for windows of `n_frames` inputs.
    pub(crate) fn new(shape: &NetworkShape, n_frames: usize, layers: &DecoderLayers) -> Self {
        let chunk = |frames: Range<usize>| {
            let maps: [Vec<f32>; LEVELS] = std::array::from_fn(|level| {
                let plane = layers.doublings[level].plane_in();
                vec![0.0; frames.len() * DECODER_CHANNELS[level] * plane]
            });
            let last = &layers.doublings[LEVELS - 1];
            let channels_out = |level: usize| layers.doublings[level].channels_out;
            Chunk {
                dy: maps.clone(),
                u: maps,
                sums: Sums::default(),
                scratch: std::array::from_fn(|level| layers.doublings[level].scratch()),
                d_seed: layers.seed.gradient(),
                d_weights: std::array::from_fn(|level| {
                    vec![[0.0; LANES]; DECODER_CHANNELS[level] * channels_out(level)]
                }),
                patch_sums: std::array::from_fn(|level| vec![Lanes::ZERO; channels_out(level)]),
                d_last: LastLayer::gradient(shape.n_states),
                d_hidden: vec![0.0; frames.len() * shape.hidden],
                loss: CellLoss::new(&[], shape.n_states, 0),
                logits: vec![0.0; shape.n_states * last.plane_out()],
                values: vec![UNOBSERVED; last.plane_out()],
                dz: vec![0.0; last.plane_out()],
                frames,
            }
        };
        Self {
            shape: *shape,
            chunks: chunks_of(n_frames).map(chunk).collect(),
        }
    }

    /// The maps of all frames from the states `h_1 .. h_K`, with the statistics of this window.
    pub(crate) fn forward(
        &mut self,
        parameters: &Tensors,
        layers: &mut DecoderLayers,
        hidden: &[f32],
        dropout: &Dropout,
    ) {
        for_each_chunk(
            &mut self.chunks,
            &SeedForward {
                seed: &layers.seed,
                hidden,
                dropout,
            },
        );
        layers.norms.clear();
        layers.norms.push(self.norm(0, parameters));
        for level in 1..LEVELS {
            let before = Level::new(level - 1, layers, dropout);
            for_each_chunk(&mut self.chunks, &DoublingForward(before));
            layers.norms.push(self.norm(level, parameters));
        }
    }

    fn norm(&self, level: usize, parameters: &Tensors) -> Norm {
        let sums = Sums::total(self.chunks.iter().map(|chunk| &chunk.sums));
        let n_frames: usize = self.chunks.iter().map(|chunk| chunk.frames.len()).sum();
        let cells: usize = self.shape.doubled(level).iter().product();
        let origin = vec![0.0; DECODER_CHANNELS[level]];
        let statistics = Statistics::new(&sums, &origin, (n_frames * cells) as f64);
        let (weight, bias) = parameters.layer(DECODER_NORMS[level]);
        Norm::new(statistics, weight, bias)
    }

    /// The loss, and the gradients of the last doubling and of the observation matrix.
    pub(crate) fn loss(
        &mut self,
        parameters: &Tensors,
        layers: &DecoderLayers,
        window: &Window,
        dropout: &Dropout,
        gradient: &mut Tensors,
    ) -> f64 {
        let level = Level::new(LEVELS - 1, layers, dropout);
        let n_states = self.shape.n_states;
        let weight = parameters.get(&format!("{}.weight", DECODER[LEVELS]));
        let input = level.doubling().input;
        let loss = CellLoss::new(parameters.get(OBSERVATION), n_states, window.n_targets());
        let last = LastLayer::new(input, n_states, weight, level.norm());
        let states = (0..n_states as u16).collect();
        let pass = Loss {
            level,
            last,
            window,
            loss,
            states,
        };
        for_each_chunk(&mut self.chunks, &pass);
        let losses = || self.chunks.iter().map(|chunk| &chunk.loss);
        gradient
            .get_mut(OBSERVATION)
            .copy_from_slice(&CellLoss::gradient(losses()));
        self.write_doubling(&pass.level, gradient);
        let d_weight = gradient.get_mut(&format!("{}.weight", DECODER[LEVELS]));
        for chunk in &self.chunks {
            LastLayer::add_gradient(&chunk.d_last, n_states, d_weight);
        }
        losses().map(CellLoss::sum).sum::<f64>() / window.n_targets() as f64
    }

    /// Gradients of all other parameters, and of the states `h_1 .. h_K` (returned).
    pub(crate) fn backward(
        &mut self,
        layers: &DecoderLayers,
        hidden: &[f32],
        dropout: &Dropout,
        gradient: &mut Tensors,
    ) -> Vec<f32> {
        for level in (1..LEVELS).rev() {
            let norm = self.norm_gradient(level, layers, gradient);
            let before = Level::new(level - 1, layers, dropout);
            let pass = DoublingBackward {
                level: before,
                norm: &norm,
            };
            for_each_chunk(&mut self.chunks, &pass);
            self.write_doubling(&pass.level, gradient);
        }
        let norm = self.norm_gradient(0, layers, gradient);
        let seed = &layers.seed;
        for_each_chunk(
            &mut self.chunks,
            &SeedBackward {
                seed,
                norm: &norm,
                hidden,
                dropout,
            },
        );
        let d_seed = total(self.chunks.iter().map(|chunk| &chunk.d_seed[..]));
        let d_weight = gradient.get_mut(&format!("{}.weight", DECODER[0]));
        d_weight.copy_from_slice(&seed.unpadded(&d_seed));
        let d_hidden = self.chunks.iter().flat_map(|chunk| &chunk.d_hidden);
        d_hidden.copied().collect()
    }

    fn norm_gradient(
        &self,
        level: usize,
        layers: &DecoderLayers,
        gradient: &mut Tensors,
    ) -> NormGradient {
        let sums = Sums::total(self.chunks.iter().map(|chunk| &chunk.sums));
        let norm = layers.norms[level].gradient(&sums);
        gradient.set_layer(DECODER_NORMS[level], &norm.weight, &norm.bias);
        norm
    }

    /// The gradient of a doubling's weights, from all chunks.
    fn write_doubling(&self, level: &Level<'_>, gradient: &mut Tensors) {
        let index = level.level;
        let mut patch_sums = vec![Lanes::ZERO; level.doubling().channels_out];
        let d_weight = gradient.get_mut(&format!("{}.weight", DECODER[index + 1]));
        d_weight.fill(0.0);
        for chunk in &self.chunks {
            let chunk_weights = chunk.d_weights[index].as_flattened();
            for (sum, d) in d_weight.iter_mut().zip(chunk_weights) {
                *sum += d;
            }
            for (sum, patches) in patch_sums.iter_mut().zip(&chunk.patch_sums[index]) {
                *sum = sum.add::<Portable>(*patches);
            }
        }
        let kernels = d_weight.as_chunks_mut().0;
        level
            .doubling()
            .add_constant_gradient(&level.floors, &patch_sums, kernels);
    }
}

struct SeedForward<'a> {
    seed: &'a Seed,
    hidden: &'a [f32],
    dropout: &'a Dropout,
}

impl Pass<Chunk> for SeedForward<'_> {
    #[inline(always)]
    fn run<A: Arithmetic>(&self, chunk: &mut Chunk) {
        chunk.sums = Sums::zeros(DECODER_CHANNELS[0]);
        let length = DECODER_CHANNELS[0] * self.seed.plane();
        let n_hidden = chunk.d_hidden.len() / chunk.frames.len().max(1);
        for (frame, u) in chunk
            .frames
            .clone()
            .zip(chunk.u[0].chunks_exact_mut(length))
        {
            let h = &self.hidden[frame * n_hidden..][..n_hidden];
            let kept = self.dropout.decoder[0].kept(frame);
            self.seed.forward::<A>(h, kept, self.dropout.scale, u);
            add_moments::<A>(u, self.seed.plane(), kept, &mut chunk.sums);
        }
    }
}

/// Adds the sums of `u` and its square of the kept channels of one frame.
#[inline(always)]
fn add_moments<A: Arithmetic>(u: &[f32], plane: usize, kept: &[u16], sums: &mut Sums) {
    for (u, &channel) in u.chunks_exact(plane).zip(kept) {
        sums.add(usize::from(channel), sum_and_product::<A>(u, u));
    }
}

struct DoublingForward<'a>(Level<'a>);

impl Pass<Chunk> for DoublingForward<'_> {
    #[inline(always)]
    fn run<A: Arithmetic>(&self, chunk: &mut Chunk) {
        let (level, doubling) = (&self.0, self.0.doubling());
        let plane = doubling.plane_out();
        chunk.sums = Sums::zeros(doubling.channels_out);
        let scratch = &mut chunk.scratch[level.level];
        let (before, after) = chunk.u.split_at_mut(level.level + 1);
        let inputs = before[level.level].chunks_exact(level.length_in());
        let outputs = after[0].chunks_exact_mut(level.length_out());
        for ((frame, input), output) in chunk.frames.clone().zip(inputs).zip(outputs) {
            let kept = level.mask().kept(frame);
            let kept_after = level.dropout.decoder[level.level + 1].kept(frame);
            doubling.values::<A>(
                input,
                kept,
                level.norm(),
                &level.floors,
                &mut scratch.values,
            );
            let factor = level.dropout.scale;
            doubling.forward::<A>(
                [kept, kept_after],
                &level.constants,
                factor,
                scratch,
                output,
            );
            add_moments::<A>(output, plane, kept_after, &mut chunk.sums);
        }
    }
}

struct DoublingBackward<'a> {
    level: Level<'a>,
    /// Of the doubling's output.
    norm: &'a NormGradient,
}

impl Pass<Chunk> for DoublingBackward<'_> {
    #[inline(always)]
    fn run<A: Arithmetic>(&self, chunk: &mut Chunk) {
        let level = &self.level;
        let (index, doubling) = (level.level, level.doubling());
        let plane = doubling.plane_out();
        chunk.clear(index);
        for (number, frame) in chunk.frames.clone().enumerate() {
            let outputs = level.dropout.decoder[index + 1].kept(frame);
            let first = number * level.length_out();
            for (at, &channel) in outputs.iter().enumerate() {
                let range = first + at * plane..first + (at + 1) * plane;
                let (u, dy) = (
                    &chunk.u[index + 1][range.clone()],
                    &chunk.dy[index + 1][range],
                );
                let factor = level.dropout.scale;
                before_dropout::<A>(u, dy, self.norm, channel, factor, &mut chunk.dz);
                doubling.place_gradient(at, &chunk.dz, &mut chunk.scratch[index]);
            }
            chunk.through_doubling::<A>(level, number, frame, outputs);
        }
    }
}

/// `dz` of one channel: back through normalisation and dropout.
#[inline(always)]
fn before_dropout<A: Arithmetic>(
    u: &[f32],
    dy: &[f32],
    norm: &NormGradient,
    channel: u16,
    factor: f32,
    dz: &mut [f32],
) {
    let channel = usize::from(channel);
    let dy_factor = norm.dy_factor[channel] * factor;
    let (u_factor, constant) = (
        norm.u_factor[channel] * factor,
        norm.constant[channel] * factor,
    );
    for ((dz, u), dy) in dz.iter_mut().zip(u).zip(dy) {
        *dz = A::mul_add(*dy, dy_factor, A::mul_add(*u, u_factor, constant));
    }
}

impl Chunk {
    /// Forgets a doubling's gradients, and sums, before a backward pass.
    fn clear(&mut self, level: usize) {
        self.sums = Sums::zeros(DECODER_CHANNELS[level]);
        self.d_weights[level].fill([0.0; LANES]);
        self.patch_sums[level].fill(Lanes::ZERO);
    }

    /// From the placed gradients of one frame's outputs to those of its normalised inputs.
    #[inline(always)]
    fn through_doubling<A: Arithmetic>(
        &mut self,
        level: &Level<'_>,
        number: usize,
        frame: usize,
        outputs: &[u16],
    ) {
        let (index, doubling, norm) = (level.level, level.doubling(), level.norm());
        let (kept, lost) = (level.mask().kept(frame), level.mask().lost(frame));
        let at = number * level.length_in()..(number + 1) * level.length_in();
        let (u, dy) = (&self.u[index][at.clone()], &mut self.dy[index][at]);
        let scratch = &mut self.scratch[index];
        doubling.values::<A>(u, kept, norm, &level.floors, &mut scratch.values);
        doubling.backward::<A>([kept, outputs], scratch, &mut self.d_weights[index]);
        for (&output, sum) in outputs.iter().zip(&scratch.patch_sums) {
            let total = &mut self.patch_sums[index][usize::from(output)];
            *total = total.add::<A>(*sum);
        }
        before_relu::<A>(doubling, norm, [u, &scratch.dx], kept, dy, &mut self.sums);
        for &channel in lost
            .iter()
            .filter(|&&channel| level.floors[usize::from(channel)] > 0.0)
        {
            let dy = doubling.lost_gradient::<A>(channel, outputs, &scratch.patch_sums);
            self.sums.add(usize::from(channel), (dy, 0.0));
        }
    }
}

/// `dy` of the kept channels of one frame: back through ReLU; and its sums.
#[inline(always)]
fn before_relu<A: Arithmetic>(
    doubling: &Doubling,
    norm: &Norm,
    [u, dx]: [&[f32]; 2],
    kept: &[u16],
    dy: &mut [f32],
    sums: &mut Sums,
) {
    let (plane, pixels) = (doubling.plane_in(), doubling.input[0] * doubling.input[1]);
    let planes = u.chunks_exact(plane).zip(dx.chunks_exact(plane));
    for (((u, dx), dy), &channel) in planes.zip(dy.chunks_exact_mut(plane)).zip(kept) {
        let channel = usize::from(channel);
        let (scale, shift) = (norm.scale[channel], norm.shift[channel]);
        for ((dy, u), dx) in dy[..pixels].iter_mut().zip(u).zip(dx) {
            *dy = if A::mul_add(*u, scale, shift) > 0.0 {
                *dx
            } else {
                0.0
            };
        }
        sums.add(channel, sum_and_product::<A>(dy, u));
    }
}

/// The last doubling, softmax, observation matrix and loss: of each frame's successor.
struct Loss<'a> {
    level: Level<'a>,
    last: LastLayer,
    window: &'a Window,
    loss: CellLoss,
    states: Vec<u16>,
}

impl Pass<Chunk> for Loss<'_> {
    #[inline(always)]
    fn run<A: Arithmetic>(&self, chunk: &mut Chunk) {
        let doubling = self.level.doubling();
        let n_cells = 4 * doubling.input[0] * doubling.input[1];
        chunk.clear(self.level.level);
        chunk.d_last.fill(Lanes::ZERO);
        chunk.loss = self.loss.clone();
        for (number, frame) in chunk.frames.clone().enumerate() {
            if self.window.targets(frame).len() * DENSE_FROM < n_cells {
                self.at_visits::<A>(chunk, number, frame);
            } else {
                self.everywhere::<A>(chunk, number, frame);
            }
        }
    }
}

impl Loss<'_> {
    #[inline(always)]
    fn at_visits<A: Arithmetic>(&self, chunk: &mut Chunk, number: usize, frame: usize) {
        let index = self.level.level;
        let at = number * self.level.length_in()..(number + 1) * self.level.length_in();
        let mut maps = LastMaps {
            kept: self.level.mask().kept(frame),
            plane: self.level.doubling().plane_in(),
            u: &chunk.u[index][at.clone()],
            dy: &mut chunk.dy[index][at],
            sums: &mut chunk.sums,
            d_weights: &mut chunk.d_last,
        };
        let visits = self.window.targets(frame);
        self.last.frame::<A>(visits, &mut maps, &mut chunk.loss);
    }

    #[inline(always)]
    fn everywhere<A: Arithmetic>(&self, chunk: &mut Chunk, number: usize, frame: usize) {
        let (level, doubling) = (&self.level, self.level.doubling());
        let kept = level.mask().kept(frame);
        let scratch = &mut chunk.scratch[level.level];
        let u = &chunk.u[level.level][number * level.length_in()..];
        doubling.values::<A>(u, kept, level.norm(), &level.floors, &mut scratch.values);
        let channels = [kept, &self.states[..]];
        doubling.forward::<A>(channels, &level.constants, 1.0, scratch, &mut chunk.logits);
        chunk.values.fill(UNOBSERVED);
        for visit in self.window.targets(frame) {
            let cell = usize::from(visit.row) * 2 * doubling.input[1] + usize::from(visit.col);
            chunk.values[cell] = visit.value;
        }
        self.add_cells::<A>(chunk);
        for (state, dz) in chunk.logits.chunks_exact(doubling.plane_out()).enumerate() {
            doubling.place_gradient(state, dz, &mut chunk.scratch[level.level]);
        }
        chunk.through_doubling::<A>(level, number, frame, &self.states);
    }

    /// Adds all cells' losses and turns their logits into gradients.
    #[inline(always)]
    fn add_cells<A: Arithmetic>(&self, chunk: &mut Chunk) {
        let plane = self.level.doubling().plane_out();
        let mut lanes = vec![Lanes::ZERO; self.states.len()];
        for (index, values) in chunk.values.as_chunks().0.iter().enumerate() {
            for (state, lanes) in lanes.iter_mut().enumerate() {
                *lanes = Lanes::load(&chunk.logits[state * plane + index * LANES..]);
            }
            chunk.loss.add::<A>(&mut lanes, values);
            for (state, lanes) in lanes.iter().enumerate() {
                lanes.store(&mut chunk.logits[state * plane + index * LANES..]);
            }
        }
    }
}

struct SeedBackward<'a> {
    seed: &'a Seed,
    norm: &'a NormGradient,
    hidden: &'a [f32],
    dropout: &'a Dropout,
}

impl Pass<Chunk> for SeedBackward<'_> {
    #[inline(always)]
    fn run<A: Arithmetic>(&self, chunk: &mut Chunk) {
        chunk.d_seed.fill(0.0);
        chunk.d_hidden.fill(0.0);
        let plane = self.seed.plane();
        let n_hidden = chunk.d_hidden.len() / chunk.frames.len().max(1);
        for (number, frame) in chunk.frames.clone().enumerate() {
            let h = &self.hidden[frame * n_hidden..][..n_hidden];
            let d_h = &mut chunk.d_hidden[number * n_hidden..][..n_hidden];
            for (at, &channel) in self.dropout.decoder[0].kept(frame).iter().enumerate() {
                let first = (number * DECODER_CHANNELS[0] + at) * plane;
                let (u, dy) = (
                    &chunk.u[0][first..][..plane],
                    &chunk.dy[0][first..][..plane],
                );
                let dz = &mut chunk.dz[..plane];
                before_dropout::<A>(u, dy, self.norm, channel, self.dropout.scale, dz);
                self.seed
                    .backward::<A>(h, channel, dz, d_h, &mut chunk.d_seed);
            }
        }
    }
}
