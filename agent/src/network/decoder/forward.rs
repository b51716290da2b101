//! The decoder forward: a window's maps, level by level.

use super::{Chunk, Decoder, DecoderLayers, LEVELS, Level};
use crate::network::batch_norm::{Norm, Statistics, Sums};
use crate::network::dropout::Dropout;
use crate::network::lanes::{Arithmetic, sum_and_product};
use crate::network::parallel::{Pass, for_each_chunk};
use crate::network::parameters::{DECODER_NORMS, Tensors};
use crate::network::seed::Seed;
use crate::network::shape::DECODER_CHANNELS;

impl Decoder {
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
fn add_moments<A: Arithmetic>(u: &[f32], length: usize, kept: &[u16], sums: &mut Sums) {
    for (u, &channel) in u.chunks_exact(length).zip(kept) {
        sums.add(usize::from(channel), sum_and_product::<A>(u, u));
    }
}

struct DoublingForward<'a>(Level<'a>);

impl Pass<Chunk> for DoublingForward<'_> {
    #[inline(always)]
    fn run<A: Arithmetic>(&self, chunk: &mut Chunk) {
        let (level, doubling) = (&self.0, self.0.doubling());
        let length = doubling.output().length();
        chunk.sums = Sums::zeros(doubling.channels_out);
        let scratch = &mut chunk.scratch[level.level];
        let (before, after) = chunk.u.split_at_mut(level.level + 1);
        let inputs = before[level.level].chunks_exact(level.length_in());
        let outputs = after[0].chunks_exact_mut(level.length_out());
        for ((frame, input), output) in chunk.frames.clone().zip(inputs).zip(outputs) {
            let kept = level.mask().kept(frame);
            let kept_after = level.dropout.decoder[level.level + 1].kept(frame);
            doubling.values::<A>(input, kept, level.norm(), &level.floors, scratch);
            let factor = level.dropout.scale;
            doubling.forward::<A>(
                [kept, kept_after],
                &level.constants,
                factor,
                scratch,
                output,
            );
            add_moments::<A>(output, length, kept_after, &mut chunk.sums);
        }
    }
}
