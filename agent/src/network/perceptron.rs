//! A multilayer perceptron with ReLU between its layers: the DQN's network.
//!
//! Weights are `[in][out]`, the transpose of PyTorch's, so that outputs are in lanes.

use super::lanes::{Arithmetic, LANES, Lanes};
use super::parameters::uniform;
use protocol::randomness::{Purpose, stream};

/// Rows of a product that are summed at once.
const ROWS: usize = 4;

/// The sizes and, per layer, where its numbers are.
#[derive(Debug, Clone)]
pub(crate) struct Perceptron {
    sizes: Vec<usize>,
    /// Per layer the weights, then the biases.
    pub(crate) numbers: Vec<f32>,
}

/// The outputs of each layer for a batch, the input first.
pub(crate) type Activations = Vec<Vec<f32>>;

impl Perceptron {
    /// First values as PyTorch's linear layers have them; those of a seed.
    pub(crate) fn new(sizes: &[usize], seed: u64) -> Self {
        let mut numbers = Vec::new();
        for (layer, ends) in sizes.windows(2).enumerate() {
            let mut rng = stream(seed, Purpose::Weights, 1000 + layer as u64);
            let bound = 1.0 / (ends[0] as f32).sqrt();
            let draws = (ends[0] + 1) * ends[1];
            numbers.extend((0..draws).map(|_| bound * (2.0 * uniform(&mut rng) - 1.0)));
        }
        Self {
            sizes: sizes.to_vec(),
            numbers,
        }
    }

    pub(crate) fn n_layers(&self) -> usize {
        self.sizes.len() - 1
    }

    /// Numbers into and out of a layer.
    pub(crate) fn ends(&self, layer: usize) -> [usize; 2] {
        [self.sizes[layer], self.sizes[layer + 1]]
    }

    /// Where a layer's weights and biases begin and end.
    pub(crate) fn places(&self, layer: usize) -> [usize; 3] {
        let length = |layer: usize| (self.sizes[layer] + 1) * self.sizes[layer + 1];
        let first = (0..layer).map(length).sum();
        let [inputs, outputs] = self.ends(layer);
        [first, first + inputs * outputs, first + length(layer)]
    }

    /// The same layers with other numbers.
    pub(crate) fn with_numbers(&self, numbers: &[f32]) -> Self {
        Self {
            sizes: self.sizes.clone(),
            numbers: numbers.to_vec(),
        }
    }

    /// The layers as PyTorch has them: name, shape, numbers.
    pub(crate) fn tensors(&self) -> Vec<(String, Vec<usize>, Vec<f32>)> {
        let mut tensors = Vec::new();
        for layer in 0..self.n_layers() {
            let [weight, bias, end] = self.places(layer);
            let [inputs, outputs] = self.ends(layer);
            let weights = transposed(&self.numbers[weight..bias], outputs);
            let biases = self.numbers[bias..end].to_vec();
            let name = 2 * layer;
            tensors.push((format!("{name}.weight"), vec![outputs, inputs], weights));
            tensors.push((format!("{name}.bias"), vec![outputs], biases));
        }
        tensors
    }

    /// The same layers with what is found under [`Self::tensors`]'s names and shapes.
    pub(crate) fn filled<E>(
        &self,
        found: impl Fn(&str, &[usize]) -> Result<Vec<f32>, E>,
    ) -> Result<Self, E> {
        let mut filled = self.clone();
        for layer in 0..self.n_layers() {
            let [weight, bias, end] = self.places(layer);
            let [inputs, outputs] = self.ends(layer);
            let name = 2 * layer;
            let weights = found(&format!("{name}.weight"), &[outputs, inputs])?;
            filled.numbers[weight..bias].copy_from_slice(&transposed(&weights, inputs));
            let biases = found(&format!("{name}.bias"), &[outputs])?;
            filled.numbers[bias..end].copy_from_slice(&biases);
        }
        Ok(filled)
    }

    /// All layers' outputs for the rows of `input`.
    #[inline(always)]
    pub(crate) fn forward<A: Arithmetic>(&self, input: &[f32]) -> Activations {
        let n_rows = input.len() / self.sizes[0];
        let mut activations = vec![input.to_vec()];
        for layer in 0..self.n_layers() {
            let [weight, bias, end] = self.places(layer);
            let mut output = self.numbers[bias..end].repeat(n_rows);
            let ends = self.ends(layer);
            add_product::<A>(
                &activations[layer],
                &self.numbers[weight..bias],
                ends,
                &mut output,
            );
            if layer + 1 < self.n_layers() {
                for value in &mut output {
                    *value = value.max(0.0);
                }
            }
            activations.push(output);
        }
        activations
    }

    /// The gradient of all numbers from that of the last layer's output.
    #[inline(always)]
    pub(crate) fn backward<A: Arithmetic>(
        &self,
        activations: &Activations,
        d_output: Vec<f32>,
    ) -> Vec<f32> {
        let mut gradient = vec![0.0; self.numbers.len()];
        let mut d = d_output;
        for layer in (0..self.n_layers()).rev() {
            let [weight, bias, end] = self.places(layer);
            let [inputs, outputs] = self.ends(layer);
            let n_rows = d.len() / outputs;
            for row in d.chunks_exact(outputs) {
                for (sum, d) in gradient[bias..end].iter_mut().zip(row) {
                    *sum += d;
                }
            }
            let x = transposed(&activations[layer], inputs);
            add_product::<A>(&x, &d, [n_rows, outputs], &mut gradient[weight..bias]);
            if layer > 0 {
                let mut dx = vec![0.0; n_rows * inputs];
                let weights = transposed(&self.numbers[weight..bias], outputs);
                add_product::<A>(&d, &weights, [outputs, inputs], &mut dx);
                for (dx, x) in dx.iter_mut().zip(&activations[layer]) {
                    *dx = if *x > 0.0 { *dx } else { 0.0 };
                }
                d = dx;
            }
        }
        gradient
    }
}

/// The transpose of a matrix with `columns` columns.
fn transposed(matrix: &[f32], columns: usize) -> Vec<f32> {
    let rows = matrix.len() / columns;
    let mut transposed = vec![0.0; matrix.len()];
    for (row, numbers) in matrix.chunks_exact(columns).enumerate() {
        for (column, number) in numbers.iter().enumerate() {
            transposed[column * rows + row] = *number;
        }
    }
    transposed
}

/// `c += a b` for `a` of `n_inner` and `b` of `n_columns` columns.
#[inline(always)]
fn add_product<A: Arithmetic>(
    a: &[f32],
    b: &[f32],
    [n_inner, n_columns]: [usize; 2],
    c: &mut [f32],
) {
    let whole = n_columns / LANES * LANES;
    let blocks = c.chunks_mut(ROWS * n_columns).zip(a.chunks(ROWS * n_inner));
    for (c, a) in blocks {
        for first in (0..whole).step_by(LANES) {
            if c.len() == ROWS * n_columns {
                add_block::<A, ROWS>(a, &b[first..], [n_inner, n_columns], &mut c[first..]);
            } else {
                let rows = a.chunks_exact(n_inner).zip(c.chunks_exact_mut(n_columns));
                for (a, c) in rows {
                    add_block::<A, 1>(a, &b[first..], [n_inner, n_columns], &mut c[first..]);
                }
            }
        }
        let rows = a.chunks_exact(n_inner).zip(c.chunks_exact_mut(n_columns));
        for (a, c) in rows {
            for (a, b) in a.iter().zip(b.chunks_exact(n_columns)) {
                for (c, b) in c[whole..].iter_mut().zip(&b[whole..]) {
                    *c = A::mul_add(*a, *b, *c);
                }
            }
        }
    }
}

/// Sixteen columns of `R` rows.
#[inline(always)]
fn add_block<A: Arithmetic, const R: usize>(
    a: &[f32],
    b: &[f32],
    [n_inner, n_columns]: [usize; 2],
    c: &mut [f32],
) {
    let rows: [&[f32]; R] = std::array::from_fn(|row| &a[row * n_inner..][..n_inner]);
    let mut sums: [Lanes; R] = std::array::from_fn(|row| Lanes::load(&c[row * n_columns..]));
    for (inner, b) in b.chunks(n_columns).enumerate().take(n_inner) {
        let b = Lanes::load(b);
        for row in 0..R {
            sums[row] = sums[row].add_scaled::<A>(rows[row][inner], b);
        }
    }
    for (row, sum) in sums.iter().enumerate() {
        sum.store(&mut c[row * n_columns..]);
    }
}
