//! A multilayer perceptron with ReLU between its layers: the DQN's network.
//!
//! Weights are `[in][out]`, the transpose of PyTorch's, so that outputs are in lanes; each row of
//! outputs is padded to whole lanes with zeros, which stay zero as their gradients are.

use super::lanes::{Arithmetic, Lanes, whole_lanes};
use super::parameters::uniform;
use super::product::{Left, Product};
use protocol::randomness::{Purpose, stream};

/// The sizes and, per layer, where its numbers are.
#[derive(Debug, Clone)]
pub(crate) struct Perceptron {
    sizes: Vec<usize>,
    /// Per layer the weights, then the biases.
    pub(crate) numbers: Vec<f32>,
}

/// A batch of inputs, and room for what the layers make of it.
#[derive(Debug, Clone, Default)]
pub(crate) struct Batch {
    /// One row each, not padded.
    pub(crate) input: Vec<f32>,
    /// Of each layer, rows in whole lanes.
    outputs: Vec<Vec<f32>>,
    /// Their gradients.
    d_outputs: Vec<Vec<f32>>,
    /// One layer's weights, `[out][in]`.
    turned: Vec<f32>,
}

/// One layer: sizes, and where its numbers are.
#[derive(Debug, Clone, Copy)]
struct Layer {
    inputs: usize,
    outputs: usize,
    /// Numbers per row of outputs.
    row: usize,
    weight: usize,
    bias: usize,
    end: usize,
}

impl Perceptron {
    /// First values as PyTorch's linear layers have them; those of a seed.
    pub(crate) fn new(sizes: &[usize], seed: u64) -> Self {
        let mut network = Self {
            sizes: sizes.to_vec(),
            numbers: Vec::new(),
        };
        for index in 0..network.n_layers() {
            let layer = network.layer(index);
            let mut rng = stream(seed, Purpose::Weights, 1000 + index as u64);
            let bound = 1.0 / (layer.inputs as f32).sqrt();
            for _ in 0..=layer.inputs {
                let row = (0..layer.outputs).map(|_| bound * (2.0 * uniform(&mut rng) - 1.0));
                network.numbers.extend(row);
                network
                    .numbers
                    .resize(network.numbers.len().next_multiple_of(layer.row), 0.0);
            }
        }
        network
    }

    fn n_layers(&self) -> usize {
        self.sizes.len() - 1
    }

    fn layer(&self, index: usize) -> Layer {
        let row = |layer: usize| whole_lanes(self.sizes[layer + 1]);
        let length = |layer: usize| (self.sizes[layer] + 1) * row(layer);
        let weight: usize = (0..index).map(length).sum();
        let end = weight + length(index);
        Layer {
            inputs: self.sizes[index],
            outputs: self.sizes[index + 1],
            row: row(index),
            weight,
            bias: end - row(index),
            end,
        }
    }

    /// All layers' outputs for the rows of `batch.input`.
    #[inline(always)]
    pub(crate) fn forward<A: Arithmetic>(&self, batch: &mut Batch) {
        let n_rows = batch.input.len() / self.sizes[0];
        batch.outputs.resize(self.n_layers(), Vec::new());
        for index in 0..self.n_layers() {
            let layer = self.layer(index);
            let (before, after) = batch.outputs.split_at_mut(index);
            let left = match before.last() {
                Some(input) => Left::rows(input, self.layer(index - 1).row),
                None => Left::rows(&batch.input, layer.inputs),
            };
            let output = &mut after[0];
            output.resize(n_rows * layer.row, 0.0);
            let product = Product {
                left,
                right: &self.numbers[layer.weight..layer.bias],
                n_inner: layer.inputs,
                n_columns: layer.row,
                start: Some(&self.numbers[layer.bias..layer.end]),
            };
            product.write::<A>(output);
            if index + 1 < self.n_layers() {
                for value in output {
                    *value = value.max(0.0);
                }
            }
        }
    }

    /// The gradient of all numbers from that of the last layer's outputs, [`Batch::d_values`].
    #[inline(always)]
    pub(crate) fn backward<A: Arithmetic>(&self, batch: &mut Batch, gradient: &mut [f32]) {
        for index in (0..self.n_layers()).rev() {
            self.weight_gradient::<A>(batch, index, gradient);
            if index > 0 {
                self.input_gradient::<A>(batch, index);
            }
        }
    }

    /// `dW = x^T d`, and the sum of `d` for the biases.
    #[inline(always)]
    fn weight_gradient<A: Arithmetic>(&self, batch: &Batch, index: usize, gradient: &mut [f32]) {
        let layer = self.layer(index);
        let d = &batch.d_outputs[index];
        let left = match index.checked_sub(1) {
            Some(before) => Left::columns(&batch.outputs[before], self.layer(before).row),
            None => Left::columns(&batch.input, layer.inputs),
        };
        let product = Product {
            left,
            right: d,
            n_inner: d.len() / layer.row,
            n_columns: layer.row,
            start: None,
        };
        product.write::<A>(&mut gradient[layer.weight..layer.bias]);
        let bias = &mut gradient[layer.bias..layer.end];
        bias.fill(0.0);
        for row in d.chunks_exact(layer.row) {
            for (sum, d) in bias.as_chunks_mut().0.iter_mut().zip(row.as_chunks().0) {
                *sum = Lanes(*sum).add::<A>(Lanes(*d)).0;
            }
        }
    }

    /// `dx = d W^T` where ReLU let `x` pass, else zero.
    #[inline(always)]
    fn input_gradient<A: Arithmetic>(&self, batch: &mut Batch, index: usize) {
        let (layer, row) = (self.layer(index), self.layer(index - 1).row);
        let weight = &self.numbers[layer.weight..layer.bias];
        turn([layer.inputs, layer.row], weight, row, &mut batch.turned);
        let (before, after) = batch.d_outputs.split_at_mut(index);
        let (dx, d) = (&mut before[index - 1], &after[0]);
        dx.resize(d.len() / layer.row * row, 0.0);
        let product = Product {
            left: Left::rows(d, layer.row),
            right: &batch.turned,
            n_inner: layer.outputs,
            n_columns: row,
            start: None,
        };
        product.write::<A>(dx);
        for (dx, x) in dx.iter_mut().zip(&batch.outputs[index - 1]) {
            *dx = if *x > 0.0 { *dx } else { 0.0 };
        }
    }

    /// The sizes and numbers of all layers in PyTorch's order: per layer the weight `[out][in]` and bias.
    pub(crate) fn tensors(&self) -> Vec<(String, Vec<usize>, Vec<f32>)> {
        let tensors = (0..self.n_layers()).flat_map(|index| {
            let layer = self.layer(index);
            let weight = &self.numbers[layer.weight..layer.bias];
            let weights = (0..layer.outputs * layer.inputs)
                .map(|at| weight[at % layer.inputs * layer.row + at / layer.inputs]);
            let bias = &self.numbers[layer.bias..][..layer.outputs];
            let name = 2 * index;
            let dims = vec![layer.outputs, layer.inputs];
            [
                (format!("{name}.weight"), dims, weights.collect()),
                (format!("{name}.bias"), vec![layer.outputs], bias.to_vec()),
            ]
        });
        tensors.collect()
    }

    /// A network of the same sizes with tensors as [`Self::tensors`] gives them: `get` is asked for each
    /// by name and size.
    pub(crate) fn with_tensors<E>(
        &self,
        mut get: impl FnMut(&str, &[usize]) -> Result<Vec<f32>, E>,
    ) -> Result<Self, E> {
        let mut network = self.clone();
        for (index, pair) in self.tensors().chunks_exact(2).enumerate() {
            let layer = self.layer(index);
            let [weight, bias] = [0, 1].map(|which| get(&pair[which].0, &pair[which].1));
            for (at, number) in weight?.into_iter().enumerate() {
                let at = at % layer.inputs * layer.row + at / layer.inputs;
                network.numbers[layer.weight + at] = number;
            }
            network.numbers[layer.bias..][..layer.outputs].copy_from_slice(&bias?);
        }
        Ok(network)
    }

    /// A network of the same sizes with other numbers, in the same order.
    pub(crate) fn with_numbers(&self, numbers: &[f32]) -> Self {
        Self {
            sizes: self.sizes.clone(),
            numbers: numbers.to_vec(),
        }
    }
}

impl Batch {
    /// What the last layer gave for each row of the input, in whole lanes.
    pub(crate) fn values(&self) -> &[f32] {
        self.outputs.last().expect("invariant: a layer")
    }

    /// The gradient of [`Self::values`], to be filled.
    pub(crate) fn d_values(&mut self) -> &mut [f32] {
        self.d_outputs.resize(self.outputs.len(), Vec::new());
        let values = self.outputs.last().expect("invariant: a layer");
        let d_values = self.d_outputs.last_mut().expect("invariant: a layer");
        d_values.clear();
        d_values.resize(values.len(), 0.0);
        d_values
    }
}

/// The transpose of a matrix, with rows padded to `length`.
#[inline(always)]
fn turn([rows, columns]: [usize; 2], matrix: &[f32], length: usize, to: &mut Vec<f32>) {
    /// Rows at once: a cache line of what is written.
    const BLOCK: usize = 16;
    to.resize(columns * length, 0.0);
    for (block, matrix) in matrix[..rows * columns].chunks(BLOCK * columns).enumerate() {
        for (column, to) in to.chunks_exact_mut(length).enumerate() {
            let numbers = matrix[column..].iter().step_by(columns);
            for (to, number) in to[block * BLOCK..].iter_mut().zip(numbers) {
                *to = *number;
            }
        }
    }
}
