//! `Decoder(h)` of paper eq. 9: a seed of few cells, doubled four times, with Dropout2d, normalisation and ReLU
//! between.

use crate::batch_norm::BatchNorm;
use crate::dropout::Mask;
use crate::ops::doubling::Doubling;
use crate::ops::doubling_at_targets::DoublingAtTargets;
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
        let z = self.doubled(self.levels.len(), hidden, pass)?;
        let [.., rows, cols] = *z.dims() else {
            unreachable!("invariant: a map has rows and columns");
        };
        z.reshape((pass.window.len(), (), rows, cols))
    }

    /// Logits of the cells that each frame's successor shows, `[targets, states]`.
    pub fn at_targets(&self, hidden: &Tensor, pass: &Pass<'_>) -> Result<Tensor> {
        if self.is_stock {
            return gather_targets(&self.forward(hidden, pass)?, pass);
        }
        let last = self.levels.len() - 1;
        let z = self.doubled(last, hidden, pass)?;
        let op = DoublingAtTargets {
            moments: self.moments(last, &z, pass)?,
            input: pass.decoder_mask(last).clone(),
            window: pass.window.clone(),
        };
        let level = &self.levels[last];
        z.apply_op3(&level.norm.weights()?, &level.kernels, op)
    }

    /// The map after so many doublings: `[frames, channels, rows, cols]`, of our operators `[planes, rows, cols]`.
    fn doubled(&self, n_doublings: usize, hidden: &Tensor, pass: &Pass<'_>) -> Result<Tensor> {
        let (n_hidden, channels, rows, cols) = self.seed.dims4()?;
        let seed = hidden.matmul(&self.seed.reshape((n_hidden, ()))?)?;
        let mut z = match self.is_stock {
            true => seed.reshape(((), channels, rows, cols))?,
            false => seed.reshape(((), rows, cols))?,
        };
        for level in 0..n_doublings {
            z = match self.is_stock {
                true => self.stock(level, &z, pass)?,
                false => self.ours(level, &z, pass)?,
            };
        }
        Ok(z)
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
        let op = Doubling {
            moments: self.moments(level, z, pass)?,
            input: pass.decoder_mask(level).clone(),
            output,
        };
        z.apply_op3(&norm.weights()?, kernels, op)
    }

    fn moments(&self, level: usize, z: &Tensor, pass: &Pass<'_>) -> Result<Moments> {
        let of_window = || Moments::of(z, pass.decoder_mask(level));
        self.levels[level].norm.moments(pass, of_window)
    }
}

/// The stock path from logits of all cells to those of targets.
fn gather_targets(logits: &Tensor, pass: &Pass<'_>) -> Result<Tensor> {
    let (_, n_states, rows, cols) = logits.dims4()?;
    let cells = (0..pass.window.len()).flat_map(|frame| {
        let targets = pass.window.targets(frame).iter();
        targets.map(move |visit| {
            let (row, col) = (usize::from(visit.row), usize::from(visit.col));
            ((frame * rows + row) * cols + col) as u32
        })
    });
    let cells = Tensor::new(cells.collect::<Vec<u32>>(), logits.device())?;
    let by_cell = logits.permute((0, 2, 3, 1))?.reshape(((), n_states))?;
    by_cell.index_select(&cells, 0)
}
