//! The decoder backward: from the gradients before the last doubling to those of everything else.

use super::{Chunk, Decoder, DecoderLayers, LEVELS, Level};
use crate::network::batch_norm::{Norm, NormGradient, Sums};
use crate::network::deconv::Doubling;
use crate::network::dropout::Dropout;
use crate::network::encoder::total;
use crate::network::lanes::{Arithmetic, Lanes, Portable, sum_and_product};
use crate::network::parallel::{Pass, for_each_chunk};
use crate::network::parameters::{DECODER, DECODER_NORMS, Tensors};
use crate::network::seed::Seed;
use crate::network::shape::DECODER_CHANNELS;
use crate::network::visited::Touched;

impl Decoder {
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
    pub(super) fn write_doubling(&self, level: &Level<'_>, gradient: &mut Tensors) {
        let index = level.level;
        let mut patch_sums = vec![Lanes::ZERO; level.doubling().channels_out];
        let d_weight = gradient.get_mut(&format!("{}.weight", DECODER[index + 1]));
        d_weight.fill(0.0);
        for chunk in &self.chunks {
            let kernels = d_weight.as_chunks_mut().0.iter_mut();
            for (sum, d) in kernels.zip(&chunk.d_weights[index]) {
                *sum = Lanes(*sum).add::<Portable>(*d).0;
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
        let length = doubling.output().length();
        chunk.clear(index);
        for (number, frame) in chunk.frames.clone().enumerate() {
            let outputs = level.dropout.decoder[index + 1].kept(frame);
            let place = number * level.length_out()..(number + 1) * level.length_out();
            let dy = match &chunk.touched[number] {
                Some(touched) if index + 2 == LEVELS => {
                    Touched::spread(touched, outputs, length, &mut chunk.spread);
                    &chunk.spread
                }
                _ => &chunk.dy[index + 1][place.clone()],
            };
            let maps = chunk.u[index + 1][place].chunks_exact(length);
            let maps = maps.zip(dy.chunks_exact(length)).zip(outputs);
            for (at, ((u, dy), &channel)) in maps.enumerate() {
                let undo = BeforeDropout::new(self.norm, channel, level.dropout.scale);
                doubling.place_gradient(at, &mut chunk.scratch[index], |first, dz| {
                    let range = first..first + dz.len();
                    undo.write::<A>(&u[range.clone()], &dy[range], dz);
                });
            }
            chunk.through_doubling::<A>(level, number, frame, outputs);
        }
    }
}

/// Of one channel: back through normalisation and dropout.
struct BeforeDropout {
    dy_factor: f32,
    u_factor: f32,
    constant: f32,
}

impl BeforeDropout {
    #[inline(always)]
    fn new(norm: &NormGradient, channel: u16, factor: f32) -> Self {
        let channel = usize::from(channel);
        Self {
            dy_factor: norm.dy_factor[channel] * factor,
            u_factor: norm.u_factor[channel] * factor,
            constant: norm.constant[channel] * factor,
        }
    }

    /// `dz` of some pixels.
    #[inline(always)]
    fn write<A: Arithmetic>(&self, u: &[f32], dy: &[f32], dz: &mut [f32]) {
        for ((dz, u), dy) in dz.iter_mut().zip(u).zip(dy) {
            *dz = A::mul_add(
                *dy,
                self.dy_factor,
                A::mul_add(*u, self.u_factor, self.constant),
            );
        }
    }
}

impl Chunk {
    /// From the placed gradients of one frame's outputs to those of its normalised inputs.
    #[inline(always)]
    pub(super) fn through_doubling<A: Arithmetic>(
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
        doubling.values::<A>(u, kept, norm, &level.floors, scratch);
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
    let (map, plane) = (doubling.input, doubling.plane_in());
    let planes = u.chunks_exact(map.length()).zip(dx.chunks_exact(plane));
    for (((u, dx), dy), &channel) in planes.zip(dy.chunks_exact_mut(map.length())).zip(kept) {
        let channel = usize::from(channel);
        let (scale, shift) = (norm.scale[channel], norm.shift[channel]);
        map.take_rows::<A>(dx, dy);
        for (dy, u) in dy.iter_mut().zip(u) {
            *dy = if A::mul_add(*u, scale, shift) > 0.0 {
                *dy
            } else {
                0.0
            };
        }
        sums.add(channel, sum_and_product::<A>(dy, u));
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
        let plane = self.seed.plane();
        let n_hidden = chunk.d_hidden.len() / chunk.frames.len().max(1);
        let mut sums = vec![Lanes::ZERO; n_hidden];
        for (number, frame) in chunk.frames.clone().enumerate() {
            let h = &self.hidden[frame * n_hidden..][..n_hidden];
            sums.fill(Lanes::ZERO);
            for (at, &channel) in self.dropout.decoder[0].kept(frame).iter().enumerate() {
                let first = (number * DECODER_CHANNELS[0] + at) * plane;
                let (u, dy) = (
                    &chunk.u[0][first..][..plane],
                    &chunk.dy[0][first..][..plane],
                );
                let dz = &mut chunk.dz[..plane];
                BeforeDropout::new(self.norm, channel, self.dropout.scale).write::<A>(u, dy, dz);
                self.seed
                    .backward::<A>(h, channel, dz, &mut sums, &mut chunk.d_seed);
            }
            let d_h = &mut chunk.d_hidden[number * n_hidden..][..n_hidden];
            for (d_h, sum) in d_h.iter_mut().zip(&sums) {
                *d_h = sum.sum();
            }
        }
    }
}
