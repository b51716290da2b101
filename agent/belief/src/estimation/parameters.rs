//! The parameters of a learned filter, stored as unconstrained values: weights `w >= 0`, the observation probabilities
//! `P(y | x)`, and the first belief `u_0`.
//!
//! `w` is the softplus of the first tensor. Each row of `P(y | x)` is the softmax of a row of the second tensor, and
//! `u_0` is the softmax of the third. Unconstrained values are clamped to ±[`BOUND`], so that no weight or probability
//! is zero and eqs. 3 and 5 never divide by zero.

use crate::estimation::belief::Belief;
use emberwatch_model::randomness::split_mix;
use emberwatch_model::{MAX_KERNEL_SIDE, MAX_VALUES, Shape};
use ndarray::{Array2, Array4};
use serde::{Deserialize, Serialize};

/// Maximum magnitude of an unconstrained value: weights are at least 1e-7, and probabilities at least 1e-14.
pub const BOUND: f32 = 16.0;

/// The initial weights are chosen for states that persist and spread.
const OWN_WEIGHT: f64 = 1.0;
const NEIGHBOUR_WEIGHT: f64 = 0.1;
/// Initial weight of all other transitions, as a fraction of the two weights above.
const OTHER_STATE: f64 = 0.005;

/// With three observations, the initial probability of a state's own observation is 0.86.
const OWN_OBSERVATION: f32 = 2.5;

/// Without noise, states that share an observation would learn the same parameters.
const NOISE: f32 = 0.1;

/// The dimensions of a learned filter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Dimensions {
    pub n_states: usize,
    pub n_observations: usize,
    /// Number of rows and number of columns of the kernel, both odd.
    pub kernel: (usize, usize),
}

/// Three tensors in the order of [`Parameters::NAMES`], which contain unconstrained values, the gradients of these
/// values, or their Adam moments.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameters {
    pub dimensions: Dimensions,
    /// `[S, S, KH, KW]`, `[S, O]`, and `[S]`, row-major.
    pub tensors: [Vec<f32>; 3],
}

/// The weights and probabilities that [`Parameters`] encode.
#[derive(Debug, Clone, PartialEq)]
pub struct Tables {
    pub dimensions: Dimensions,
    /// `w[to, from, row, col]`.
    pub kernel: Vec<f32>,
    /// `P(y | x)`, shape `[S, O]`.
    pub likelihood: Vec<f32>,
    /// The belief about each cell before the first frame, shape `[S]`.
    pub initial: Vec<f32>,
}

impl Dimensions {
    /// Checks the dimensions against the limits of a model, and returns them.
    ///
    /// # Errors
    /// If a dimension is out of range. The error names the first such dimension.
    pub fn check(self) -> Result<Self, String> {
        let counts = [
            ("states", 2, self.n_states),
            ("observations", 1, self.n_observations),
        ];
        for (name, least, got) in counts {
            if !(least..=MAX_VALUES).contains(&got) {
                let expected = format!("{least} to {MAX_VALUES}");
                return Err(format!(
                    "learned filter: {name}: expected {expected}, got {got}"
                ));
            }
        }
        let is_side = |side: usize| side % 2 == 1 && side <= MAX_KERNEL_SIDE;
        let (height, width) = self.kernel;
        if !(is_side(height) && is_side(width)) {
            return Err(format!(
                "learned filter: kernel: expected odd sides up to {MAX_KERNEL_SIDE}, got {height} x {width}"
            ));
        }
        Ok(self)
    }

    /// Returns the shapes of the tensors, in the order of [`Parameters::NAMES`].
    pub fn shapes(&self) -> [Vec<usize>; 3] {
        let (states, (height, width)) = (self.n_states, self.kernel);
        let kernel = vec![states, states, height, width];
        [kernel, vec![states, self.n_observations], vec![states]]
    }

    /// Returns the number of entries of each tensor.
    pub fn lengths(&self) -> [usize; 3] {
        self.shapes().map(|shape| shape.iter().product())
    }
}

impl Parameters {
    /// Names of the tensors in files and messages.
    pub const NAMES: [&'static str; 3] = ["kernel", "likelihood", "initial"];

    /// Returns the initial parameters for learning.
    ///
    /// With these parameters, states persist and spread to neighbours. Each state is mostly observed as the value with
    /// the same index, if that value exists.
    pub fn first(dimensions: Dimensions, seed: u64) -> Self {
        let [n_kernel, n_likelihood, n_initial] = dimensions.lengths();
        // Uniform in -1..1.
        let noise = |index: usize| {
            let bits = split_mix(seed, index as u64) >> 40;
            NOISE * (bits as f32 / (1 << 23) as f32 - 1.0)
        };
        let kernel = |index| {
            let weight = first_weight(dimensions, index) * f64::from(1.0 + noise(index));
            weight.exp_m1().ln() as f32
        };
        let logit = |index: usize| {
            let state = index / dimensions.n_observations;
            let seen = index % dimensions.n_observations;
            let own = if state == seen { OWN_OBSERVATION } else { 0.0 };
            own + noise(n_kernel + index)
        };
        Self {
            dimensions,
            tensors: [
                (0..n_kernel).map(kernel).collect(),
                (0..n_likelihood).map(logit).collect(),
                vec![0.0; n_initial],
            ],
        }
    }

    /// Returns tensors of zeros.
    pub fn zeros(dimensions: Dimensions) -> Self {
        let tensors = dimensions.lengths().map(|length| vec![0.0; length]);
        Self {
            dimensions,
            tensors,
        }
    }

    /// Computes the weights and probabilities.
    pub fn tables(&self) -> Tables {
        let [kernel, _, initial] = &self.tensors;
        let cast = |numbers: Vec<f64>| numbers.into_iter().map(|number| number as f32).collect();
        let weight = |&free: &f32| softplus(f64::from(free)) as f32;
        Tables {
            dimensions: self.dimensions,
            kernel: kernel.iter().map(weight).collect(),
            likelihood: cast(self.likelihood()),
            initial: cast(softmax(initial)),
        }
    }

    /// Computes `P(y | x)`, shape `[S, O]`.
    pub fn likelihood(&self) -> Vec<f64> {
        let rows = self.tensors[1].chunks_exact(self.dimensions.n_observations);
        rows.flat_map(softmax).collect()
    }

    /// Converts gradients with respect to [`Tables`] into gradients with respect to the parameters, by the chain rule.
    pub fn chain(&self, by_tables: &[Vec<f64>; 3]) -> Self {
        let [kernel, likelihood, initial] = &self.tensors;
        let [by_kernel, by_likelihood, by_initial] = by_tables;
        let slope = |(&free, by): (&f32, &f64)| (by / (1.0 + (-f64::from(free)).exp())) as f32;
        let n_observations = self.dimensions.n_observations;
        let rows = likelihood
            .chunks_exact(n_observations)
            .zip(by_likelihood.chunks_exact(n_observations));
        Self {
            dimensions: self.dimensions,
            tensors: [
                kernel.iter().zip(by_kernel).map(slope).collect(),
                rows.flat_map(|(free, by)| softmax_gradient(free, by))
                    .collect(),
                softmax_gradient(initial, by_initial),
            ],
        }
    }

    /// Returns the name of the first tensor that contains an infinite value or NaN.
    pub fn not_finite(&self) -> Option<&'static str> {
        let tensors = Self::NAMES.into_iter().zip(&self.tensors);
        let wrong = |(_, numbers): &(&str, &Vec<f32>)| !numbers.iter().all(|x| x.is_finite());
        tensors.into_iter().find(wrong).map(|(name, _)| name)
    }

    /// Clamps all values to ±[`BOUND`].
    pub fn bound(&mut self) {
        for number in self.tensors.iter_mut().flatten() {
            *number = number.clamp(-BOUND, BOUND);
        }
    }
}

impl Tables {
    /// Returns the learned belief before the first frame, the same in every cell.
    pub fn prior(&self, shape: Shape) -> Belief {
        Belief::everywhere(&self.initial, shape)
    }

    /// Returns the kernel as an array of shape `[S, S, KH, KW]`.
    pub fn kernel_array(&self) -> Array4<f64> {
        let (n, (height, width)) = (self.dimensions.n_states, self.dimensions.kernel);
        let weights = self.kernel.iter().map(|&weight| f64::from(weight));
        let kernel = Array4::from_shape_vec((n, n, height, width), weights.collect());
        kernel.expect("invariant: S x S kernels")
    }

    /// Returns `P(y | x)` as an array of shape `[S, O]`.
    pub fn likelihood_array(&self) -> Array2<f64> {
        let numbers = self.likelihood.iter().map(|&p| f64::from(p));
        let dim = (self.dimensions.n_states, self.dimensions.n_observations);
        Array2::from_shape_vec(dim, numbers.collect()).expect("invariant: S x O numbers")
    }
}

fn first_weight(dimensions: Dimensions, index: usize) -> f64 {
    let (height, width) = dimensions.kernel;
    let n_taps = height * width;
    let (pair, tap) = (index / n_taps, index % n_taps);
    let (to, from) = (pair / dimensions.n_states, pair % dimensions.n_states);
    let is_own = to == from;
    let is_centre = tap == n_taps / 2;
    let near = if is_centre {
        OWN_WEIGHT
    } else {
        NEIGHBOUR_WEIGHT
    };
    near * if is_own { 1.0 } else { OTHER_STATE }
}

fn softplus(free: f64) -> f64 {
    free.max(0.0) + (-free.abs()).exp().ln_1p()
}

fn softmax(logits: &[f32]) -> Vec<f64> {
    let largest = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let exponentials = logits.iter().map(|&x| f64::from(x - largest).exp());
    let exponentials: Vec<f64> = exponentials.collect();
    let sum: f64 = exponentials.iter().sum();
    exponentials.into_iter().map(|x| x / sum).collect()
}

fn softmax_gradient(logits: &[f32], by: &[f64]) -> Vec<f32> {
    let p = softmax(logits);
    let mean: f64 = p.iter().zip(by).map(|(p, by)| p * by).sum();
    let gradient = p.iter().zip(by).map(|(p, by)| (p * (by - mean)) as f32);
    gradient.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn dimensions() -> Dimensions {
        Dimensions {
            n_states: 3,
            n_observations: 4,
            kernel: (3, 1),
        }
    }

    #[test]
    fn tables_are_valid_and_gradients_agree_with_differences() {
        let tables = Parameters::first(dimensions(), 7).tables();
        let rows = tables.likelihood.chunks_exact(4);
        for row in rows.chain([&*tables.initial]) {
            assert!((row.iter().sum::<f32>() - 1.0).abs() < 1e-6, "{row:?}");
        }
        assert!(tables.kernel.iter().all(|&w| w > 0.0));
        assert!((tables.kernel[1] - 1.0).abs() < 0.11, "own weight");
        let parameters = Parameters::first(dimensions(), 3);
        // The function to differentiate: a linear function of the tables with arbitrary factors.
        let factors: [Vec<f64>; 3] = dimensions().lengths().map(|length| {
            let factor = |index| (index as f64 * 0.7).sin();
            (0..length).map(factor).collect()
        });
        let value = |parameters: &Parameters| -> f64 {
            let tables = parameters.tables();
            let all = [tables.kernel, tables.likelihood, tables.initial];
            let products = all.iter().flatten().zip(factors.iter().flatten());
            let product = |(&table, factor): (&f32, &f64)| f64::from(table) * factor;
            products.map(product).sum()
        };
        let gradient = parameters.chain(&factors);
        for tensor in 0..3 {
            for index in 0..parameters.tensors[tensor].len() {
                let moved = |by: f32| {
                    let mut moved = parameters.clone();
                    moved.tensors[tensor][index] += by;
                    let by = moved.tensors[tensor][index] - parameters.tensors[tensor][index];
                    (value(&moved), f64::from(by))
                };
                let ((above, up), (below, down)) = (moved(1e-2), moved(-1e-2));
                let expected = (above - below) / (up - down);
                let got = f64::from(gradient.tensors[tensor][index]);
                let off = (got - expected).abs();
                assert!(off < 1e-4, "{tensor} {index}: {got} {expected}");
            }
        }
    }

    #[test]
    fn dimensions_out_of_range_are_named() {
        let refused = |change: fn(&mut Dimensions), words: &str| {
            let mut dimensions = dimensions();
            change(&mut dimensions);
            let error = dimensions.check().expect_err(words);
            assert!(error.contains(words), "{error}");
        };
        refused(|it| it.n_states = 1, "states: expected 2 to 64, got 1");
        refused(|it| it.n_observations = 65, "got 65");
        refused(|it| it.kernel = (3, 2), "odd sides up to 15, got 3 x 2");
    }
}
