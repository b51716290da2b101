//! The linear layer from the normalised, flattened last map to the encoding.

use crate::network::batch_norm::Norm;
use crate::network::lanes::{Arithmetic, Buffer, Lanes, sum_and_product};
use crate::network::parameters::{LINEAR, Tensors};
use crate::network::shape::ConvShape;

/// The linear layer from the normalised, flattened last map to the encoding.
#[derive(Debug)]
pub(crate) struct Linear {
    pub(super) shape: ConvShape,
    /// `[encoding][position][channel]`, channels padded to whole lanes.
    pub(super) weight: Buffer,
    pub(super) bias: Vec<f32>,
    pub(super) input: Norm,
}

#[derive(Debug)]
pub(super) struct LinearGradient {
    pub(super) weight: Buffer,
    pub(super) bias: Vec<f32>,
    /// One frame's input.
    pub(super) x: Buffer,
}

impl LinearGradient {
    pub(super) fn zeros(encoding: usize, length: usize) -> Self {
        Self {
            weight: Buffer::zeros(encoding * length),
            bias: vec![0.0; encoding],
            x: Buffer::zeros(length),
        }
    }
}

impl Linear {
    pub(crate) fn new(
        shape: ConvShape,
        encoding: usize,
        parameters: &Tensors,
        input: &Norm,
    ) -> Self {
        let (weight, bias) = parameters.layer(LINEAR);
        let mut linear = Self {
            shape,
            weight: Buffer::zeros(encoding * shape.outputs()),
            bias: bias.to_vec(),
            input: input.clone(),
        };
        for (index, entry) in weight.iter().enumerate() {
            let at = linear.place(index);
            linear.weight[at] = *entry;
        }
        linear
    }

    /// Where PyTorch's entry `[encoding][channel][position]` is.
    fn place(&self, index: usize) -> usize {
        let (channels, positions) = (self.shape.channels_out, self.shape.positions());
        let (row, channel, position) = (
            index / (channels * positions),
            index / positions % channels,
            index % positions,
        );
        (row * positions + position) * self.shape.lanes_out() + channel
    }

    /// Gradients in PyTorch's layout.
    pub(super) fn flattened(&self, weight: &[f32]) -> Vec<f32> {
        let rows = self.bias.len() * self.shape.channels_out * self.shape.positions();
        (0..rows).map(|index| weight[self.place(index)]).collect()
    }

    /// The normalised map.
    #[inline(always)]
    fn input<A: Arithmetic>(&self, map: &[f32], x: &mut [f32]) {
        let (scale, shift) = (
            Lanes::load(&self.input.scale),
            Lanes::load(&self.input.shift),
        );
        for (map, x) in map.as_chunks().0.iter().zip(x.as_chunks_mut().0) {
            *x = shift.add_product::<A>(Lanes(*map), scale).0;
        }
    }

    /// One frame's encoding; `x` is room for the normalised map.
    #[inline(always)]
    pub(crate) fn forward<A: Arithmetic>(&self, map: &[f32], x: &mut [f32], encoding: &mut [f32]) {
        self.input::<A>(map, x);
        let rows = self.weight.chunks_exact(x.len());
        for ((encoding, bias), row) in encoding.iter_mut().zip(&self.bias).zip(rows) {
            *encoding = bias + sum_and_product::<A>(x, row).1;
        }
    }

    #[inline(always)]
    pub(super) fn backward<A: Arithmetic>(
        &self,
        map: &[f32],
        d: &[f32],
        dx: &mut [f32],
        gradient: &mut LinearGradient,
    ) {
        self.input::<A>(map, &mut gradient.x);
        dx.fill(0.0);
        let length = dx.len();
        for (row, d) in d.iter().enumerate() {
            gradient.bias[row] += d;
            let weight = &self.weight[row * length..][..length];
            let d_weight = &mut gradient.weight[row * length..][..length];
            for at in 0..length {
                dx[at] = A::mul_add(*d, weight[at], dx[at]);
                d_weight[at] = A::mul_add(*d, gradient.x[at], d_weight[at]);
            }
        }
    }
}
