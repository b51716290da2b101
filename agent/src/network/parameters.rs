//! Named tensors in one vector of numbers: the network's parameters, their gradients, Adam's moments.
//!
//! Names and layouts are PyTorch's, so the authors' tensors load as they are.

use super::shape::{DECODER_CHANNELS, DOUBLING_KERNEL, NetworkShape};
use protocol::randomness::{Purpose, stream};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::Rng;
use std::ops::Range;
use std::sync::Arc;

/// The observation matrix before its softmax, `[O, S]`.
pub(crate) const OBSERVATION: &str = "W_obs_param";

/// The encoder's convolutions and the normalisations after them.
pub(crate) const ENCODER: [[&str; 2]; 3] = [
    ["encoder.0", "encoder.3"],
    ["encoder.4", "encoder.7"],
    ["encoder.8", "encoder.11"],
];

/// The layer from the flattened map to the encoding.
pub(crate) const LINEAR: &str = "encoder.13";

/// The decoder's transposed convolutions.
pub(crate) const DECODER: [&str; 5] = [
    "decoder.0",
    "decoder.4",
    "decoder.8",
    "decoder.12",
    "decoder.16",
];

/// The normalisations after all of them but the last.
pub(crate) const DECODER_NORMS: [&str; 4] = ["decoder.2", "decoder.6", "decoder.10", "decoder.14"];

/// One tensor's name, size and place.
#[derive(Debug, Clone, PartialEq)]
struct Entry {
    name: String,
    dims: Vec<usize>,
    range: Range<usize>,
    initial: Initial,
}

/// How a tensor begins.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Initial {
    Constant(f32),
    /// Uniform in plus minus one over the root of this.
    Uniform(usize),
    Normal,
}

/// Tensors by name.
#[derive(Debug, Clone)]
pub struct Tensors {
    entries: Arc<[Entry]>,
    pub(crate) numbers: Vec<f32>,
}

impl Tensors {
    /// What Adam moves, all zero.
    pub fn parameters(shape: &NetworkShape) -> Self {
        List::of_parameters(shape).zeros()
    }

    /// How many numbers those are; none is made.
    pub fn n_parameters(shape: &NetworkShape) -> usize {
        List::of_parameters(shape).length
    }

    /// The running statistics of every batch normalisation, as at the start.
    pub fn statistics(shape: &NetworkShape) -> Self {
        let mut list = List::default();
        let convolutions = shape.convolutions();
        let encoder = ENCODER.iter().zip(&convolutions);
        let encoder = encoder.map(|([_, norm], conv)| (*norm, conv.channels_out));
        for (norm, channels) in encoder.chain(DECODER_NORMS.into_iter().zip(DECODER_CHANNELS)) {
            let mut add = |what: &str, value| {
                let initial = Initial::Constant(value);
                list.add(&format!("{norm}.{what}"), vec![channels], initial);
            };
            add("running_mean", 0.0);
            add("running_var", 1.0);
        }
        let mut tensors = list.zeros();
        tensors.initialise(0);
        tensors
    }

    /// Draws first values, as PyTorch's layers do by default; those of a seed.
    pub fn initialise(&mut self, seed: u64) {
        for (index, entry) in self.entries.iter().enumerate() {
            let mut rng = stream(seed, Purpose::Weights, index as u64);
            let mut draw = || match entry.initial {
                Initial::Constant(value) => value,
                Initial::Uniform(fan) => (2.0 * uniform(&mut rng) - 1.0) / (fan as f32).sqrt(),
                Initial::Normal => normal(&mut rng),
            };
            self.numbers[entry.range.clone()].fill_with(&mut draw);
        }
    }

    /// The same tensors, all zero.
    pub(crate) fn zeros_like(&self) -> Self {
        self.with_numbers(&vec![0.0; self.numbers.len()])
    }

    /// The same tensors with other numbers.
    pub(crate) fn with_numbers(&self, numbers: &[f32]) -> Self {
        assert_eq!(numbers.len(), self.numbers.len(), "numbers of all tensors");
        Self {
            entries: Arc::clone(&self.entries),
            numbers: numbers.to_vec(),
        }
    }

    fn range(&self, name: &str) -> Range<usize> {
        let entry = self.entries.iter().find(|entry| entry.name == name);
        let entry = entry.unwrap_or_else(|| panic!("invariant: there is a tensor {name}"));
        entry.range.clone()
    }

    /// One tensor, row-major.
    ///
    /// # Panics
    /// If there is no tensor of this name.
    pub fn get(&self, name: &str) -> &[f32] {
        &self.numbers[self.range(name)]
    }

    /// One tensor, to be changed.
    ///
    /// # Panics
    /// If there is no tensor of this name.
    pub fn get_mut(&mut self, name: &str) -> &mut [f32] {
        let range = self.range(name);
        &mut self.numbers[range]
    }

    /// A layer's weight and bias.
    pub(crate) fn layer(&self, layer: &str) -> (&[f32], &[f32]) {
        let tensor = |what| self.get(&format!("{layer}.{what}"));
        (tensor("weight"), tensor("bias"))
    }

    /// Overwrites a layer's weight and bias.
    pub(crate) fn set_layer(&mut self, layer: &str, weight: &[f32], bias: &[f32]) {
        self.get_mut(&format!("{layer}.weight"))
            .copy_from_slice(weight);
        self.get_mut(&format!("{layer}.bias")).copy_from_slice(bias);
    }

    /// The name of the first tensor that holds a number that is not finite.
    pub(crate) fn not_finite(&self) -> Option<&str> {
        let broken = |entry: &&Entry| {
            let mut numbers = self.numbers[entry.range.clone()].iter();
            numbers.any(|number| !number.is_finite())
        };
        self.entries
            .iter()
            .find(broken)
            .map(|entry| entry.name.as_str())
    }

    /// Every tensor: name, size, numbers.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &[usize], &[f32])> {
        self.entries.iter().map(|entry| {
            let numbers = &self.numbers[entry.range.clone()];
            (entry.name.as_str(), entry.dims.as_slice(), numbers)
        })
    }
}

/// Tensors being listed.
#[derive(Default)]
struct List {
    entries: Vec<Entry>,
    length: usize,
}

impl List {
    fn of_parameters(shape: &NetworkShape) -> Self {
        let mut list = Self::default();
        list.encoder(shape);
        list.recurrence(shape);
        list.decoder(shape);
        let dims = vec![shape.n_observations, shape.n_states];
        list.add(OBSERVATION, dims, Initial::Normal);
        list
    }

    fn add(&mut self, name: &str, dims: Vec<usize>, initial: Initial) {
        let end = self.length + dims.iter().product::<usize>();
        self.entries.push(Entry {
            name: name.to_owned(),
            dims,
            range: self.length..end,
            initial,
        });
        self.length = end;
    }

    fn norm(&mut self, name: &str, channels: usize) {
        let mut add = |what: &str, value| {
            let initial = Initial::Constant(value);
            self.add(&format!("{name}.{what}"), vec![channels], initial);
        };
        add("weight", 1.0);
        add("bias", 0.0);
    }

    fn encoder(&mut self, shape: &NetworkShape) {
        for ([name, norm], conv) in ENCODER.into_iter().zip(shape.convolutions()) {
            let [height, width] = conv.kernel;
            let dims = vec![conv.channels_out, conv.channels_in, height, width];
            let initial = Initial::Uniform(conv.channels_in * conv.taps());
            self.add(&format!("{name}.weight"), dims, initial);
            self.add(&format!("{name}.bias"), vec![conv.channels_out], initial);
            self.norm(norm, conv.channels_out);
        }
        let features = shape.features();
        let initial = Initial::Uniform(features);
        let dims = vec![shape.encoding, features];
        self.add(&format!("{LINEAR}.weight"), dims, initial);
        self.add(&format!("{LINEAR}.bias"), vec![shape.encoding], initial);
    }

    fn recurrence(&mut self, shape: &NetworkShape) {
        let initial = Initial::Uniform(shape.hidden);
        let gates = 3 * shape.hidden;
        let mut add = |what: &str, dims| self.add(&format!("rnn_layer.{what}_l0"), dims, initial);
        add("weight_ih", vec![gates, shape.encoding]);
        add("weight_hh", vec![gates, shape.hidden]);
        add("bias_ih", vec![gates]);
        add("bias_hh", vec![gates]);
    }

    fn decoder(&mut self, shape: &NetworkShape) {
        let [height, width] = shape.seed();
        let channels = DECODER_CHANNELS[0];
        let initial = Initial::Uniform(channels * height * width);
        let dims = vec![shape.hidden, channels, height, width];
        self.add(&format!("{}.weight", DECODER[0]), dims, initial);
        self.norm(DECODER_NORMS[0], channels);
        for level in 0..DECODER_CHANNELS.len() {
            let [channels_in, channels_out] = shape.doubling_channels(level);
            let side = DOUBLING_KERNEL;
            let dims = vec![channels_in, channels_out, side, side];
            let name = format!("{}.weight", DECODER[level + 1]);
            self.add(&name, dims, Initial::Uniform(channels_out * side * side));
            if let Some(norm) = DECODER_NORMS.get(level + 1) {
                self.norm(norm, channels_out);
            }
        }
    }

    fn zeros(self) -> Tensors {
        Tensors {
            entries: self.entries.into(),
            numbers: vec![0.0; self.length],
        }
    }
}

/// Uniform in [0, 1), in steps of 2^-24.
pub(crate) fn uniform(rng: &mut ChaCha8Rng) -> f32 {
    (rng.next_u32() >> 8) as f32 / (1 << 24) as f32
}

/// Standard normal, by Box and Muller.
pub(crate) fn normal(rng: &mut ChaCha8Rng) -> f32 {
    let radius = (-2.0 * (1.0 - uniform(rng)).ln()).sqrt();
    radius * (std::f32::consts::TAU * uniform(rng)).cos()
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::grid::Shape;

    fn tensors(seed: u64) -> Tensors {
        let mut tensors = Tensors::parameters(&NetworkShape {
            grid: Shape::new(64, 64).expect("valid shape"),
            n_states: 3,
            n_observations: 3,
            encoding: 16,
            hidden: 16,
        });
        tensors.initialise(seed);
        tensors
    }

    #[test]
    fn first_values_depend_on_the_seed_alone_and_keep_their_bounds() {
        assert_eq!(tensors(1).numbers, tensors(1).numbers);
        assert_ne!(tensors(1).numbers, tensors(2).numbers);
        let tensors = tensors(1);
        let largest = |name| {
            let numbers = tensors.get(name).iter();
            numbers.fold(0.0_f32, |largest, number| largest.max(number.abs()))
        };
        let bound = 1.0 / (64.0_f32 * 16.0).sqrt();
        assert!((0.99 * bound..=bound).contains(&largest("decoder.4.weight")));
        assert_eq!(largest("decoder.6.weight"), 1.0);
        assert_eq!(largest("decoder.6.bias"), 0.0);
    }

    #[test]
    fn a_number_that_is_not_finite_is_found_by_its_tensor() {
        let mut tensors = tensors(1);
        assert_eq!(tensors.not_finite(), None);
        tensors.get_mut("decoder.8.weight")[7] = f32::NAN;
        assert_eq!(tensors.not_finite(), Some("decoder.8.weight"));
    }
}
