//! The encoder forward: a window's maps, stage by stage, and the encodings.

use super::{Chunk, Encoder, EncoderLayers, First, Linear, add_sums, encoder_norm, multipliers};
use crate::network::batch_norm::{Norm, Statistics, Sums};
use crate::network::conv::{Dense, Sparse};
use crate::network::dropout::Dropout;
use crate::network::lanes::{Arithmetic, LANES};
use crate::network::parallel::{Pass, for_each_chunk};
use crate::network::parameters::{ENCODER, Tensors};
use crate::network::window::Window;

impl Encoder {
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
        let first = First {
            sparse: &sparse,
            window,
            dropout,
        };
        let pass = SparseForward {
            first,
            origin: &origin,
        };
        for_each_chunk(&mut self.chunks, &pass);
        let norm = self.norm(0, parameters, &origin);
        let conv = self.convolve(1, parameters, &norm, first);
        let second = self.norm(1, parameters, &[0.0; LANES]);
        let last = self.convolve(2, parameters, &second, first);
        let third = self.norm(2, parameters, &[0.0; LANES]);
        let linear = Linear::new(shapes[2], self.encoding, parameters, &third);
        for_each_chunk(&mut self.chunks, &LinearForward { linear: &linear });
        let encodings = self.chunks.iter().flat_map(|chunk| &chunk.encodings);
        let layers = EncoderLayers {
            sparse,
            dense: [conv, last],
            linear,
            norms: [norm, second, third],
        };
        (encodings.copied().collect(), layers)
    }

    fn convolve(
        &mut self,
        stage: usize,
        parameters: &Tensors,
        input: &Norm,
        first: First<'_>,
    ) -> Dense {
        let (weight, bias) = parameters.layer(ENCODER[stage][0]);
        let conv = Dense::new(self.shapes[stage], weight, bias, input);
        for_each_chunk(
            &mut self.chunks,
            &DenseForward {
                stage,
                conv: &conv,
                first,
            },
        );
        conv
    }

    /// The normalisation after a stage, whose sums the chunks hold.
    fn norm(&self, stage: usize, parameters: &Tensors, origin: &[f32]) -> Norm {
        let sums = Sums::total(self.chunks.iter().map(|chunk| &chunk.sums));
        let count = (self.n_frames() * self.shapes[stage].positions()) as f64;
        encoder_norm(stage, parameters, Statistics::new(&sums, origin, count))
    }
}

struct SparseForward<'a> {
    first: First<'a>,
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
            let map = match self.first.is_kept(frame) {
                true => map,
                false => &mut *chunk.first,
            };
            self.first.compute::<A>(frame, map);
            add_sums::<A>(map, None, self.origin, &mut chunk.sums);
        }
    }
}

struct DenseForward<'a> {
    stage: usize,
    conv: &'a Dense,
    first: First<'a>,
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
            let dropout = self.first.dropout;
            let mask = multipliers(&dropout.encoder[self.stage], frame, dropout.scale);
            let kept = dropout.encoder[self.stage - 1].kept(frame);
            let input = match self.stage {
                1 => self.first.recall::<A>(frame, input, &mut chunk.first),
                _ => input,
            };
            self.conv.forward::<A>(input, kept, &mask, output);
            add_sums::<A>(output, None, &[0.0; LANES], &mut chunk.sums);
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
