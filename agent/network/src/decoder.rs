//! `Decoder(h)` of paper eq. 9. It starts from a seed of a few cells and doubles its sides four times, with Dropout2d,
//! normalisation and ReLU in between.

use crate::batch_norm::BatchNorm;
use crate::dropout::Mask;
use crate::observation_matrix::ObservationMatrix;
use crate::operators::Operators;
use crate::ops::activation::Order;
use crate::ops::cell_loss::window_loss;
use crate::ops::chain::Chain;
use crate::ops::conv::{Conv, Sizes};
use crate::ops::cpu::{Frames, derived, numbers};
use crate::ops::stage::Layer;
use crate::pass::Pass;
use crate::shape::{DECODER_CHANNELS, NetworkShape};
use crate::variables::uniform_init;
use candle_core::{Device, Result, Tensor};
use candle_nn::VarBuilder;

/// Indices of the transposed convolutions, and of the normalisations after them, in the authors' list of layers.
const CONVOLUTIONS: [usize; 5] = [0, 4, 8, 12, 16];
const NORMS: [usize; 4] = [2, 6, 10, 14];

const KERNEL: usize = 4;

/// The decoder, from hidden vectors to logits of states.
#[derive(Debug)]
pub struct Decoder {
    /// The weights `[hidden, channels, rows, cols]` of a transposed convolution. Applied to a single cell, this
    /// convolution is a matrix product.
    seed: Tensor,
    levels: Vec<Level>,
    operators: Operators,
}

#[derive(Debug)]
struct Level {
    norm: BatchNorm,
    kernels: Tensor,
}

impl Decoder {
    /// Creates a decoder that computes with the given operators.
    pub fn new(vb: &VarBuilder<'_>, shape: &NetworkShape, operators: Operators) -> Result<Self> {
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
            operators,
        })
    }

    /// Computes the logits of all cells of the padded grid, `[frames, states, rows, cols]`, for predictions only: our
    /// operators do not propagate gradients here.
    pub fn forward(&self, hidden: &Tensor, pass: &Pass<'_>) -> Result<Tensor> {
        let z = self.seed(hidden)?;
        match self.operators {
            Operators::Stock => self.stock(z, pass),
            Operators::Own => {
                let all = Mask::all(pass.window.len(), self.n_states()?);
                let layers = self.layers(pass, &all)?;
                let [states, rows, cols] = last_map(&layers);
                let (_, logits) = self.chain(&z, &layers, pass)?;
                let dims = (pass.window.len(), states, rows, cols);
                Tensor::from_vec(logits.concat(), dims, &Device::Cpu)
            }
        }
    }

    /// Computes the loss at the window's targets (eqs. 8 and 11) if these are predicted from hidden vectors.
    pub fn loss(
        &self,
        hidden: &Tensor,
        observation: &ObservationMatrix,
        pass: &Pass<'_>,
    ) -> Result<Tensor> {
        let z = self.seed(hidden)?;
        match self.operators {
            Operators::Stock => observation.loss(&self.stock(z, pass)?, pass.window),
            Operators::Own => self.own_loss(&z, &observation.matrix()?.contiguous()?, pass),
        }
    }

    /// Computes the loss and its gradients together. This avoids a tensor of logits, and is possible because the loss
    /// is a scalar.
    fn own_loss(&self, z: &Tensor, observation: &Tensor, pass: &Pass<'_>) -> Result<Tensor> {
        let all = Mask::all(pass.window.len(), self.n_states()?);
        let layers = self.layers(pass, &all)?;
        let (chain, logits) = self.chain(z, &layers, pass)?;
        let matrix = numbers(observation)?;
        let loss = window_loss(pass.window, &logits, &matrix, last_map(&layers));
        drop(matrix);
        let mut gradients = chain.backward(loss.d_logits)?;
        gradients.extend(loss.d_observation);
        let mut from = vec![z];
        from.extend(layers.iter().flat_map(Layer::tensors));
        from.push(observation);
        derived(&from, (), vec![loss.loss as f32], move |d_loss| {
            gradients.iter().map(|d| d * d_loss[0]).collect()
        })
    }

    fn chain(&self, z: &Tensor, layers: &[Layer<'_>], pass: &Pass<'_>) -> Result<(Chain, Frames)> {
        let moments = |level: usize, of_window| self.levels[level].norm.moments(pass, of_window);
        Chain::forward((z, pass.decoder_mask(0)), layers, Order::NormFirst, moments)
    }

    fn n_states(&self) -> Result<usize> {
        let last = self.levels.last().expect("invariant: four levels");
        last.kernels.dim(1)
    }

    fn layers<'a>(&'a self, pass: &'a Pass<'_>, all: &'a Mask) -> Result<Vec<Layer<'a>>> {
        let (_, _, mut rows, mut cols) = self.seed.dims4()?;
        let levels = self.levels.iter().enumerate();
        levels
            .map(|(index, Level { norm, kernels })| {
                let (from, to, ..) = kernels.dims4()?;
                let sizes = Sizes {
                    small: [from, rows, cols],
                    large: [to, 2 * rows, 2 * cols],
                    kernel: [KERNEL; 2],
                    stride: 2,
                    padding: 1,
                    dilation: 1,
                };
                (rows, cols) = (2 * rows, 2 * cols);
                let is_last = index + 1 == self.levels.len();
                Ok(Layer {
                    conv: Conv::new(sizes),
                    transposed: true,
                    weights: Layer::weights_of(kernels)?,
                    bias: None,
                    norm: Some(norm.weights()),
                    output: if is_last {
                        all
                    } else {
                        pass.decoder_mask(index + 1)
                    },
                })
            })
            .collect()
    }

    /// Computes the first feature maps, `[frames, channels, rows, cols]`.
    fn seed(&self, hidden: &Tensor) -> Result<Tensor> {
        let (n_hidden, channels, rows, cols) = self.seed.dims4()?;
        let seed = hidden.matmul(&self.seed.reshape((n_hidden, ()))?)?;
        seed.reshape(((), channels, rows, cols))
    }

    fn stock(&self, mut z: Tensor, pass: &Pass<'_>) -> Result<Tensor> {
        for (level, Level { norm, kernels }) in self.levels.iter().enumerate() {
            let mask = pass.decoder_mask(level).tensor(z.dtype(), z.device())?;
            let kept = z.broadcast_mul(&mask.unsqueeze(2)?.unsqueeze(3)?)?;
            let x = norm.forward(&kept, pass)?.relu()?;
            z = x.conv_transpose2d(kernels, 1, 0, 2, 1)?;
        }
        Ok(z)
    }
}

fn last_map(layers: &[Layer<'_>]) -> [usize; 3] {
    let last = layers.last().expect("invariant: four levels");
    last.conv.sizes.large
}
