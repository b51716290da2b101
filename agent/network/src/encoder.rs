//! `Encoder(y)` of paper eq. 9: three convolutions, each with Dropout2d, ReLU and normalisation, and a linear layer.

use crate::batch_norm::BatchNorm;
use crate::dropout::Mask;
use crate::operators::Operators;
use crate::ops::activation::Order;
use crate::ops::chain::Chain;
use crate::ops::conv::{Conv, Sizes};
use crate::ops::cpu::{Frames, derived};
use crate::ops::stage::Layer;
use crate::pass::Pass;
use crate::shape::{ConvShape, NetworkShape};
use crate::variables::uniform_init;
use candle_core::{DType, Device, Result, Tensor};
use candle_nn::{Linear, Module, VarBuilder};

/// Indices of the convolutions and of the normalisations in the authors' list of layers.
const STAGES: [(usize, usize); 3] = [(0, 3), (4, 7), (8, 11)];
const LINEAR: usize = 13;

/// The encoder, from frames to encodings.
#[derive(Debug)]
pub struct Encoder {
    stages: Vec<Stage>,
    linear: Linear,
    operators: Operators,
}

#[derive(Debug)]
struct Stage {
    shape: ConvShape,
    weight: Tensor,
    bias: Tensor,
    norm: BatchNorm,
}

impl Encoder {
    /// Creates an encoder that computes with the given operators.
    pub fn new(vb: &VarBuilder<'_>, shape: &NetworkShape, operators: Operators) -> Result<Self> {
        let stages = STAGES.iter().zip(shape.convolutions());
        let stages = stages.map(|(places, shape)| Stage::new(vb, *places, shape));
        let init = uniform_init(shape.features());
        let (vb, dims) = (vb.pp(LINEAR), (shape.encoding, shape.features()));
        let weight = vb.get_with_hints(dims, "weight", init)?;
        let bias = vb.get_with_hints(shape.encoding, "bias", init)?;
        Ok(Self {
            stages: stages.collect::<Result<_>>()?,
            linear: Linear::new(weight, Some(bias)),
            operators,
        })
    }

    /// Computes the encodings of all frames, `[frames, encoding]`.
    pub fn forward(&self, pass: &Pass<'_>) -> Result<Tensor> {
        match self.operators {
            Operators::Stock => self.linear.forward(&self.stock(pass)?),
            Operators::Own => self.ours(pass),
        }
    }

    /// Feature maps have the shape `[frames, channels, rows, cols]`.
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

    /// The linear layer is computed as a convolution whose kernel covers the whole map.
    fn ours(&self, pass: &Pass<'_>) -> Result<Tensor> {
        let (n_frames, encoding) = (pass.window.len(), self.linear.weight().dim(0)?);
        let all = Mask::all(n_frames, encoding);
        let mut layers = Vec::with_capacity(self.stages.len() + 1);
        let mut norm = None;
        for (index, stage) in self.stages.iter().enumerate() {
            let ConvShape {
                channels_in,
                channels_out,
                kernel,
                stride,
                input,
                output,
            } = stage.shape;
            let sizes = Sizes {
                large: [channels_in, input[0], input[1]],
                small: [channels_out, output[0], output[1]],
                kernel,
                stride,
                padding: 0,
                dilation: 1,
            };
            let mask = pass.encoder_mask(index);
            layers.push(layer(sizes, &stage.weight, &stage.bias, norm, mask)?);
            norm = Some(stage.norm.weights());
        }
        let large = layers[self.stages.len() - 1].conv.sizes.small;
        let sizes = Sizes {
            large,
            small: [encoding, 1, 1],
            kernel: [large[1], large[2]],
            stride: 1,
            padding: 0,
            dilation: 1,
        };
        let [channels, rows, cols] = large;
        let weight = self.linear.weight();
        let weight = weight.reshape((encoding, channels, rows, cols))?;
        let bias = self
            .linear
            .bias()
            .expect("invariant: the linear layer has a bias");
        layers.push(layer(sizes, &weight, bias, norm, &all)?);
        let moments =
            |index: usize, of_window| self.stages[index - 1].norm.moments(pass, of_window);
        let first = &self.stages[0].shape;
        let seen = Mask::all(n_frames, first.channels_in);
        let maps =
            (pass.window).one_hot(first.channels_in, first.input, DType::F32, &Device::Cpu)?;
        let input = (&maps, &seen);
        let (chain, encodings) = Chain::forward(input, &layers, Order::ReluFirst, moments)?;
        let (dims, encodings) = ((n_frames, encoding), encodings.concat());
        if !pass.trains() {
            return Tensor::from_vec(encodings, dims, &Device::Cpu);
        }
        let from: Vec<_> = layers.iter().flat_map(Layer::tensors).collect();
        derived(&from, dims, encodings, move |d| {
            let gradients = chain.backward(Frames::of(n_frames, d));
            gradients.expect("invariant: the forward pass has read the same tensors")
        })
    }
}

/// Creates a layer from a convolution's `weight [channels out, channels in, rows, cols]`.
fn layer<'a>(
    sizes: Sizes,
    weight: &Tensor,
    bias: &'a Tensor,
    norm: Option<[&'a Tensor; 2]>,
    output: &'a Mask,
) -> Result<Layer<'a>> {
    Ok(Layer {
        conv: Conv::new(sizes),
        transposed: false,
        weights: Layer::weights_of(weight)?,
        bias: Some(bias),
        norm,
        output,
    })
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

    fn stock_conv(&self, x: &Tensor) -> Result<Tensor> {
        let z = x.conv2d(&self.weight, 0, self.shape.stride, 1, 1)?;
        z.broadcast_add(&self.bias.reshape((1, (), 1, 1))?)
    }
}
