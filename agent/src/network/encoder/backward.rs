//! The encoder backward: from the gradients of the encodings to those of all its parameters.

use super::{Chunk, Encoder, EncoderLayers, First, Linear, add_sums, multipliers, total};
use crate::network::batch_norm::{NormGradient, Sums};
use crate::network::conv::{Dense, DenseGradient};
use crate::network::dropout::Dropout;
use crate::network::lanes::{Arithmetic, LANES, Lanes};
use crate::network::parallel::{Pass, for_each_chunk};
use crate::network::parameters::{ENCODER, LINEAR, Tensors};
use crate::network::window::Window;

impl Encoder {
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
        let first = First {
            sparse: &layers.sparse,
            window,
            dropout,
        };
        for stage in [2, 1] {
            let norm = self.norm_gradient(stage, layers, gradient);
            let conv = &layers.dense[stage - 1];
            for_each_chunk(
                &mut self.chunks,
                &DenseBackward {
                    stage,
                    conv,
                    norm: &norm,
                    first,
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
        for_each_chunk(&mut self.chunks, &SparseBackward { first, norm: &norm });
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

/// `dz` of a frame: back through normalisation, ReLU and dropout.
#[inline(always)]
fn before_relu<A: Arithmetic>(
    d_map: &[f32],
    map: &[f32],
    norm: &NormGradient,
    mask: &[f32],
    dz: &mut [f32],
) {
    let channels = norm.constant.len();
    let positions = map
        .chunks_exact(channels)
        .zip(d_map.chunks_exact(channels))
        .zip(dz.chunks_exact_mut(channels));
    for ((map, d_map), dz) in positions {
        for first in (0..channels).step_by(LANES) {
            let lanes = |numbers: &[f32]| Lanes::load(&numbers[first..]);
            let du = lanes(&norm.constant)
                .add_product::<A>(lanes(map), lanes(&norm.u_factor))
                .add_product::<A>(lanes(d_map), lanes(&norm.dy_factor));
            let (map, mask) = (lanes(map), lanes(mask));
            let through = |lane: usize| match map.0[lane] > 0.0 {
                true => du.0[lane] * mask.0[lane],
                false => 0.0,
            };
            Lanes(std::array::from_fn(through)).store(&mut dz[first..]);
        }
    }
}

struct DenseBackward<'a> {
    stage: usize,
    conv: &'a Dense,
    norm: &'a NormGradient,
    first: First<'a>,
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
        for (index, frame) in chunk.frames.clone().enumerate() {
            let mask = &self.first.dropout.encoder[self.stage];
            let factors = multipliers(mask, frame, self.first.dropout.scale);
            let at = index * length..(index + 1) * length;
            let (map, d_map) = (
                &chunk.maps[self.stage][at.clone()],
                &chunk.d_maps[self.stage][at],
            );
            let dz = &mut chunk.dz[..length];
            before_relu::<A>(d_map, map, self.norm, &factors, dz);
            let at = index * length_in..(index + 1) * length_in;
            let input = &chunk.maps[self.stage - 1][at.clone()];
            let input = match self.stage {
                1 => self.first.recall::<A>(frame, input, &mut chunk.first),
                _ => input,
            };
            let dx = &mut chunk.d_maps[self.stage - 1][at];
            self.conv
                .backward::<A>(input, mask.kept(frame), dz, dx, gradient);
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
    first: First<'a>,
    norm: &'a NormGradient,
}

impl Pass<Chunk> for SparseBackward<'_> {
    #[inline(always)]
    fn run<A: Arithmetic>(&self, chunk: &mut Chunk) {
        chunk.d_columns.fill(0.0);
        chunk.d_bias.fill(0.0);
        let length = chunk.maps[0].len() / chunk.frames.len().max(1);
        for (index, frame) in chunk.frames.clone().enumerate() {
            let First {
                sparse,
                window,
                dropout,
            } = self.first;
            let mask = multipliers(&dropout.encoder[0], frame, dropout.scale);
            let at = index * length..(index + 1) * length;
            let place = &chunk.maps[0][at.clone()];
            let map = self.first.recall::<A>(frame, place, &mut chunk.first);
            let d_map = &chunk.d_maps[0][at];
            let dz = &mut chunk.dz[..length];
            before_relu::<A>(d_map, map, self.norm, &mask, dz);
            let (d_columns, d_bias) = (&mut chunk.d_columns, &mut chunk.d_bias);
            let visits = window.visits(frame);
            sparse.backward::<A>(visits, dz, d_columns, d_bias);
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
