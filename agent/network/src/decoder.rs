//! `Decoder(h)` of paper eq. 9: a seed of few cells, doubled four times, with Dropout2d, normalisation and ReLU
//! between.

use crate::batch_norm::BatchNorm;
use crate::dropout::Mask;
use crate::ops::doubling::Doubling;
use crate::ops::norm::Moments;
use crate::pass::Pass;
use crate::shape::{DECODER_CHANNELS, NetworkShape};
use crate::variables::uniform_init;
use candle_core::{Result, Tensor};
use candle_nn::VarBuilder;

/// Places of the transposed convolutions and of the normalisations after them in the authors' list of layers.
const CONVOLUTIONS: [usize; 5] = [0, 4, 8, 12, 16];
const NORMS: [usize; 4] = [2, 6, 10, 14];

/// Side of the doublings' kernels.
const KERNEL: usize = 4;

/// Hidden vectors to logits of states.
#[derive(Debug)]
pub struct Decoder {
    /// `[hidden, channels, rows, cols]`: on a single cell, a transposed convolution is a matrix.
    seed: Tensor,
    levels: Vec<Level>,
    is_stock: bool,
}

/// A normalisation, and the doubling behind it.
#[derive(Debug)]
struct Level {
    norm: BatchNorm,
    kernels: Tensor,
}

impl Decoder {
    /// A decoder of stock operators or ours.
    pub fn new(vb: &VarBuilder<'_>, shape: &NetworkShape, is_stock: bool) -> Result<Self> {
        let [rows, cols] = shape.seed();
        let channels = DECODER_CHANNELS[0];
        let dims = (shape.hidden, channels, rows, cols);
        let init = uniform_init(channels * rows * cols);
        let seed = vb
            .pp(CONVOLUTIONS[0])
            .get_with_hints(dims, "weight", init)?;
        let level = |level: usize| {
            let from = DECODER_CHANNELS[level];
            let to = DECODER_CHANNELS.get(level + 1).copied();
            let to = to.unwrap_or(shape.n_states);
            let (dims, init) = (
                (from, to, KERNEL, KERNEL),
                uniform_init(to * KERNEL * KERNEL),
            );
            let vb_of_kernels = vb.pp(CONVOLUTIONS[level + 1]);
            Ok(Level {
                norm: BatchNorm::new(&vb.pp(NORMS[level]), from)?,
                kernels: vb_of_kernels.get_with_hints(dims, "weight", init)?,
            })
        };
        Ok(Self {
            seed,
            levels: (0..DECODER_CHANNELS.len())
                .map(level)
                .collect::<Result<_>>()?,
            is_stock,
        })
    }

    /// Logits of all cells of the padded grid, `[frames, states, rows, cols]`.
    pub fn forward(&self, hidden: &Tensor, pass: &Pass<'_>) -> Result<Tensor> {
        let (n_hidden, channels, rows, cols) = self.seed.dims4()?;
        let seed = hidden.matmul(&self.seed.reshape((n_hidden, ()))?)?;
        // Ours are `[planes, rows, cols]`.
        let mut z = match self.is_stock {
            true => seed.reshape(((), channels, rows, cols))?,
            false => seed.reshape(((), rows, cols))?,
        };
        for level in 0..self.levels.len() {
            z = match self.is_stock {
                true => self.stock(level, &z, pass)?,
                false => self.ours(level, &z, pass)?,
            };
        }
        let scale = 1 << self.levels.len();
        z.reshape((pass.window.len(), (), scale * rows, scale * cols))
    }

    fn stock(&self, level: usize, z: &Tensor, pass: &Pass<'_>) -> Result<Tensor> {
        let Level { norm, kernels } = &self.levels[level];
        let mask = pass.decoder_mask(level).tensor(z.dtype(), z.device())?;
        let kept = z.broadcast_mul(&mask.unsqueeze(2)?.unsqueeze(3)?)?;
        let x = norm.forward(&kept, pass)?.relu()?;
        x.conv_transpose2d(kernels, 1, 0, 2, 1)
    }

    fn ours(&self, level: usize, z: &Tensor, pass: &Pass<'_>) -> Result<Tensor> {
        let Level { norm, kernels } = &self.levels[level];
        let output = match level + 1 < self.levels.len() {
            true => pass.decoder_mask(level + 1).clone(),
            false => Mask::all(pass.window.len(), kernels.dim(1)?),
        };
        let input = pass.decoder_mask(level).clone();
        let moments = norm.moments(pass, || Moments::of(z, &input))?;
        let op = Doubling {
            input,
            output,
            moments,
        };
        z.apply_op3(&norm.weights()?, kernels, op)
    }
}
