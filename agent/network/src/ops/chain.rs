//! Chains of convolutions with dropout, normalisation and ReLU between them, over all frames of a window, with all
//! gradients: the autoencoder's encoder and decoder.

use super::activation::{Activation, Order, ResultGradient, kept_planes};
use super::cpu::{Frames, numbers};
use super::norm::{Moments, Norm};
use super::stage::{Layer, Stage};
use crate::dropout::Mask;
use candle_core::{Result, Tensor};

pub(crate) struct Chain {
    stages: Vec<Stage>,
    z: Vec<Frames>,
}

impl Chain {
    /// `moments(layer, moments of the window)` returns the moments that the layer's normalisation uses.
    pub(crate) fn forward(
        (maps, mask): (&Tensor, &Mask),
        layers: &[Layer<'_>],
        order: Order,
        mut moments: impl FnMut(usize, Moments) -> Result<Moments>,
    ) -> Result<(Self, Frames)> {
        let has_norm = |layer: &Layer<'_>| layer.norm.is_some();
        assert!(
            layers[1..].iter().all(has_norm),
            "invariant: only the first layer has no normalisation"
        );
        let (mut z, mut sums) = kept_planes(&numbers(maps)?, mask, order);
        let mut chain = Self {
            stages: Vec::new(),
            z: Vec::new(),
        };
        let mut mask = mask;
        for (index, layer) in layers.iter().enumerate() {
            let mut norm = None;
            if let Some([gamma, beta]) = layer.norm {
                let (scale, count) = (mask.scale(), mask.n_frames() * layer.in_area());
                let moments = moments(index, Moments::new(&sums, scale, count))?;
                let weights = [&*numbers(gamma)?, &*numbers(beta)?];
                norm = Some(Norm::new(weights, moments, scale));
            }
            let before = Activation::new(norm, mask.clone(), order);
            let stage = Stage::new(layer, before)?;
            let out;
            (out, sums) = stage.forward(&z, order)?;
            chain.z.push(std::mem::replace(&mut z, out));
            chain.stages.push(stage);
            mask = layer.output;
        }
        Ok((chain, z))
    }

    /// Computes the gradients of all layers from the gradient of the last layer's output, in the order of
    /// [`Layer::tensors`]. If the first layer has a normalisation, the gradient of the input maps comes first.
    pub(crate) fn backward(&self, last: Frames) -> Result<Vec<f32>> {
        let (mut parts, mut gradient) = (Vec::new(), ResultGradient::Given(last));
        for (stage, z) in self.stages.iter().zip(&self.z).rev() {
            let (dy, chunks) = stage.backward(z, &gradient)?;
            let (part, terms) = stage.finish(chunks)?;
            parts.push(part);
            let activation = &stage.before;
            gradient = ResultGradient::Through {
                activation,
                z,
                dy,
                terms,
            };
        }
        let first = &self.stages[0];
        if first.before.norm.is_some() {
            parts.push(first.before.dense(first.areas()[0], &gradient));
        }
        parts.reverse();
        Ok(parts.concat())
    }
}
