//! `Decoder(h)` of paper eq. 9: a seed of few cells, doubled four times, with Dropout2d, normalisation and ReLU
//! between.

use crate::batch_norm::BatchNorm;
use crate::dropout::Mask;
use crate::observation_matrix::ObservationMatrix;
use crate::ops::decoder::Layers;
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
            let to = DECODER_CHANNELS
                .get(level + 1)
                .copied()
                .unwrap_or(shape.n_states);
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

    /// Logits of all cells of the padded grid, `[frames, states, rows, cols]`, for predictions: through our
    /// operator goes no gradient.
    pub fn forward(&self, hidden: &Tensor, pass: &Pass<'_>) -> Result<Tensor> {
        if self.is_stock {
            return self.stock(hidden, pass);
        }
        let behind = Mask::all(pass.window.len(), self.n_states()?);
        let layers = self.layers(hidden, pass, &behind);
        layers.logits(|level, of_window| self.levels[level].norm.moments(pass, of_window))
    }

    /// The loss of what hidden vectors predict (eqs. 8 and 11): that of the window's targets.
    pub fn loss(
        &self,
        hidden: &Tensor,
        observation: &ObservationMatrix,
        pass: &Pass<'_>,
    ) -> Result<Tensor> {
        if self.is_stock {
            return observation.loss(&self.stock(hidden, pass)?, pass.window);
        }
        let behind = Mask::all(pass.window.len(), self.n_states()?);
        let (layers, matrix) = (self.layers(hidden, pass, &behind), observation.matrix()?);
        let moments = |level: usize, of_window| self.levels[level].norm.moments(pass, of_window);
        layers.loss(pass.window, &matrix.contiguous()?, moments)
    }

    fn n_states(&self) -> Result<usize> {
        let last = self.levels.last().expect("invariant: four levels");
        last.kernels.dim(1)
    }

    fn layers<'a>(
        &'a self,
        hidden: &'a Tensor,
        pass: &'a Pass<'_>,
        behind: &'a Mask,
    ) -> Layers<'a> {
        let masks = (0..self.levels.len()).map(|level| pass.decoder_mask(level));
        let levels = self.levels.iter().map(|Level { norm, kernels }| {
            let [gamma, beta] = norm.weights();
            [gamma, beta, kernels]
        });
        Layers {
            hidden,
            seed: &self.seed,
            levels: levels.collect(),
            masks: masks.chain([behind]).collect(),
        }
    }

    fn stock(&self, hidden: &Tensor, pass: &Pass<'_>) -> Result<Tensor> {
        let (n_hidden, channels, rows, cols) = self.seed.dims4()?;
        let seed = hidden.matmul(&self.seed.reshape((n_hidden, ()))?)?;
        let mut z = seed.reshape(((), channels, rows, cols))?;
        for (level, Level { norm, kernels }) in self.levels.iter().enumerate() {
            let mask = pass.decoder_mask(level).tensor(z.dtype(), z.device())?;
            let kept = z.broadcast_mul(&mask.unsqueeze(2)?.unsqueeze(3)?)?;
            let x = norm.forward(&kept, pass)?.relu()?;
            z = x.conv_transpose2d(kernels, 1, 0, 2, 1)?;
        }
        Ok(z)
    }
}
