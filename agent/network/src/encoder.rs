//! `Encoder(y)` of paper eq. 9: three convolutions, each with Dropout2d, ReLU and normalisation, and a linear
//! layer.

use crate::batch_norm::BatchNorm;
use crate::ops::encoder::{Layer, encode};
use crate::pass::Pass;
use crate::shape::{ConvShape, NetworkShape};
use crate::variables::uniform_init;
use candle_core::{Result, Tensor};
use candle_nn::{Linear, Module, VarBuilder};

/// Places of the convolutions and of the normalisations in the authors' list of layers.
const STAGES: [(usize, usize); 3] = [(0, 3), (4, 7), (8, 11)];
const LINEAR: usize = 13;

/// Frames to encodings.
#[derive(Debug)]
pub struct Encoder {
    stages: Vec<Stage>,
    linear: Linear,
    is_stock: bool,
}

#[derive(Debug)]
struct Stage {
    shape: ConvShape,
    weight: Tensor,
    bias: Tensor,
    norm: BatchNorm,
}

impl Encoder {
    /// An encoder of stock operators or ours.
    pub fn new(vb: &VarBuilder<'_>, shape: &NetworkShape, is_stock: bool) -> Result<Self> {
        let stages = STAGES.iter().zip(shape.convolutions());
        let stages = stages.map(|(places, shape)| Stage::new(vb, *places, shape));
        let init = uniform_init(shape.features());
        let (vb, dims) = (vb.pp(LINEAR), (shape.encoding, shape.features()));
        let weight = vb.get_with_hints(dims, "weight", init)?;
        let bias = vb.get_with_hints(shape.encoding, "bias", init)?;
        Ok(Self {
            stages: stages.collect::<Result<_>>()?,
            linear: Linear::new(weight, Some(bias)),
            is_stock,
        })
    }

    /// The encodings of all frames, `[frames, encoding]`.
    pub fn forward(&self, pass: &Pass<'_>) -> Result<Tensor> {
        let features = if self.is_stock {
            self.stock(pass)?
        } else {
            self.ours(pass)?
        };
        self.linear.forward(&features)
    }

    /// Maps are `[frames, channels, rows, cols]`.
    fn stock(&self, pass: &Pass<'_>) -> Result<Tensor> {
        let first = &self.stages[0];
        let (dtype, device) = (first.weight.dtype(), first.weight.device());
        let shape = &first.shape;
        let mut x = pass
            .window
            .one_hot(shape.channels_in, shape.input, dtype, device)?;
        for (index, stage) in self.stages.iter().enumerate() {
            let mask = pass.encoder_mask(index).tensor(dtype, device)?;
            let z = stage.stock_conv(&x)?;
            let kept = z.broadcast_mul(&mask.unsqueeze(2)?.unsqueeze(3)?)?;
            x = stage.norm.forward(&kept.relu()?, pass)?;
        }
        x.flatten_from(1)
    }

    fn ours(&self, pass: &Pass<'_>) -> Result<Tensor> {
        let layers = self
            .stages
            .iter()
            .enumerate()
            .map(|(index, stage)| {
                Ok(Layer {
                    shape: stage.shape,
                    kernels: stage.kernels(index == 0)?,
                    bias: &stage.bias,
                    norm: stage.norm.weights(),
                    mask: pass.encoder_mask(index),
                })
            })
            .collect::<Result<Vec<_>>>()?;
        encode(pass.window, &layers, pass.trains(), |index, of_window| {
            self.stages[index].norm.moments(pass, of_window)
        })
    }
}

impl Stage {
    fn new(vb: &VarBuilder<'_>, (conv, norm): (usize, usize), shape: ConvShape) -> Result<Self> {
        let ([rows, cols], n) = (shape.kernel, shape.channels_out);
        let init = uniform_init(shape.channels_in * rows * cols);
        let of_conv = vb.pp(conv);
        let dims = (n, shape.channels_in, rows, cols);
        Ok(Self {
            shape,
            weight: of_conv.get_with_hints(dims, "weight", init)?,
            bias: of_conv.get_with_hints(n, "bias", init)?,
            norm: BatchNorm::new(&vb.pp(norm), n)?,
        })
    }

    /// The weights as our operator takes them: of the first layer, `[channels in, rows, cols, channels out]`;
    /// of others, the channels in come third.
    fn kernels(&self, is_first: bool) -> Result<Tensor> {
        let order = if is_first { (1, 2, 3, 0) } else { (2, 3, 1, 0) };
        self.weight.permute(order)?.flatten(0, 2)?.contiguous()
    }

    fn stock_conv(&self, x: &Tensor) -> Result<Tensor> {
        let z = x.conv2d(&self.weight, 0, self.shape.stride, 1, 1)?;
        z.broadcast_add(&self.bias.reshape((1, (), 1, 1))?)
    }
}
