//! The autoencoder as named tensors: candle's, and bytes in its safetensors format.
//!
//! Parameters and running statistics go by PyTorch's names, so a checkpoint of the authors' network
//! loads; Adam's moments are `adam.first.<name>` and `adam.second.<name>`. The online state is with
//! them, so that a resumed run goes on bit for bit.

use super::autoencoder::Autoencoder;
use super::parameters::Tensors;
use crate::belief::{Belief, BeliefError};
use candle_core::{DType, Device, Tensor};
use ndarray::Array;
use std::collections::HashMap;
use thiserror::Error;

/// Steps of Adam and updates.
const COUNTERS: &str = "counters";
const HIDDEN: &str = "state.hidden";
const PREDICTION: &str = "state.prediction";

/// Tensors that are not those of this network.
#[derive(Debug, Error)]
pub enum CheckpointError {
    /// Bytes that are no safetensors file.
    #[error("{0}")]
    Damaged(#[from] candle_core::Error),
    /// A tensor is not there.
    #[error("expected a tensor {name}, got none")]
    Missing {
        /// Its name.
        name: String,
    },
    /// A tensor of another network's size.
    #[error("expected {name} of shape {expected:?}, got {got:?}")]
    Shape {
        /// The tensor.
        name: String,
        /// This network's.
        expected: Vec<usize>,
        /// The checkpoint's.
        got: Vec<usize>,
    },
    /// A tensor no network can work with.
    #[error("expected finite numbers, got one that is not in {name}")]
    NotFinite {
        /// The tensor.
        name: String,
    },
    /// A predictor that is no belief.
    #[error("{0}")]
    Prediction(#[from] BeliefError),
}

impl Autoencoder {
    /// Everything that a resumed run needs but settings, seed and [`Self::counters`]: name, shape, numbers.
    pub fn named_numbers(&self) -> Vec<(String, Vec<usize>, Vec<f32>)> {
        let mut named = Vec::new();
        let mut add = |name: String, dims: &[usize], numbers: &[f32]| {
            named.push((name, dims.to_vec(), numbers.to_vec()));
        };
        for (name, dims, numbers) in self.parameters.iter().chain(self.statistics.iter()) {
            add(name.to_owned(), dims, numbers);
        }
        let moments = [("first", &self.adam.first), ("second", &self.adam.second)];
        for (moment, numbers) in moments {
            for (name, dims, numbers) in self.parameters.with_numbers(numbers).iter() {
                add(format!("adam.{moment}.{name}"), dims, numbers);
            }
        }
        add(HIDDEN.to_owned(), &[self.hidden.len()], &self.hidden);
        let prediction = self.prediction();
        let dims = prediction.view().shape().to_vec();
        add(PREDICTION.to_owned(), &dims, prediction.as_slice());
        named
    }

    /// Steps of Adam, and updates.
    pub fn counters(&self) -> [u64; 2] {
        [self.adam.step, self.n_updates]
    }

    /// [`Self::named_numbers`] and [`Self::counters`] as candle's tensors.
    ///
    /// # Errors
    /// As candle's, which does not happen for tensors in memory.
    pub fn named_tensors(&self) -> candle_core::Result<Vec<(String, Tensor)>> {
        let tensor = |(name, dims, numbers): (String, Vec<usize>, Vec<f32>)| {
            Ok((name, Tensor::from_vec(numbers, dims, &Device::Cpu)?))
        };
        let named = self.named_numbers().into_iter().map(tensor);
        let mut named = named.collect::<candle_core::Result<Vec<_>>>()?;
        let counters = self.counters().map(|counter| counter as i64);
        named.push((COUNTERS.to_owned(), Tensor::new(&counters, &Device::Cpu)?));
        Ok(named)
    }

    /// [`Self::named_tensors`] as a safetensors file.
    ///
    /// # Errors
    /// As candle's, which does not happen for tensors in memory.
    pub fn to_safetensors(&self) -> candle_core::Result<Vec<u8>> {
        let tensors = self.named_tensors()?;
        Ok(safetensors::serialize(tensors, None)?)
    }

    /// Takes over what [`Self::to_safetensors`] gave, of a network of the same sizes.
    ///
    /// # Errors
    /// [`CheckpointError`] for anything else; nothing has changed then.
    pub fn load_safetensors(&mut self, bytes: &[u8]) -> Result<(), CheckpointError> {
        let tensors = Stored(candle_core::safetensors::load_buffer(bytes, &Device::Cpu)?);
        let counters = tensors.counters()?;
        self.load(|name, dims| tensors.numbers(name, dims), counters)
    }

    /// Takes over what [`Self::named_numbers`] and [`Self::counters`] gave, of a network of the same sizes.
    /// `numbers` finds those of a name and shape.
    ///
    /// # Errors
    /// As of `numbers`, or for a predictor that is no belief; nothing has changed then.
    pub fn load<E: From<BeliefError>>(
        &mut self,
        numbers: impl Fn(&str, &[usize]) -> Result<Vec<f32>, E>,
        counters: [u64; 2],
    ) -> Result<(), E> {
        let filled = |like: &Tensors, prefix: &str| filled(like, prefix, &numbers);
        let parameters = filled(&self.parameters, "")?;
        let statistics = filled(&self.statistics, "")?;
        let first = filled(&self.parameters, "adam.first.")?;
        let second = filled(&self.parameters, "adam.second.")?;
        let hidden = numbers(HIDDEN, &[self.hidden.len()])?;
        let dims = self.prediction().view().shape().to_vec();
        let prediction = numbers(PREDICTION, &dims)?;
        let prediction = Array::from_shape_vec((dims[0], dims[1], dims[2]), prediction);
        let prediction = prediction.expect("invariant: the tensor has this shape");
        let prediction = Belief::from_probabilities(prediction)?;
        *self.parameters_mut() = parameters;
        self.statistics = statistics;
        (self.adam.first, self.adam.second) = (first.numbers, second.numbers);
        [self.adam.step, self.n_updates] = counters;
        self.hidden = hidden;
        self.set_prediction(prediction);
        Ok(())
    }

    /// Takes over parameters and statistics alone, as of a network trained with PyTorch.
    ///
    /// # Errors
    /// [`CheckpointError`] for tensors that are missing or of another size; nothing has changed then.
    pub fn load_weights(
        &mut self,
        tensors: HashMap<String, Tensor>,
    ) -> Result<(), CheckpointError> {
        let tensors = Stored(tensors);
        let numbers = |name: &str, dims: &[usize]| tensors.numbers(name, dims);
        let parameters = filled(&self.parameters, "", &numbers)?;
        self.statistics = filled(&self.statistics, "", &numbers)?;
        *self.parameters_mut() = parameters;
        Ok(())
    }
}

/// Tensors from outside.
struct Stored(HashMap<String, Tensor>);

impl Stored {
    fn get(&self, name: &str, expected: &[usize]) -> Result<&Tensor, CheckpointError> {
        let name = || name.to_owned();
        let tensor = self.0.get(&name());
        let tensor = tensor.ok_or_else(|| CheckpointError::Missing { name: name() })?;
        if tensor.dims() == expected {
            return Ok(tensor);
        }
        Err(CheckpointError::Shape {
            name: name(),
            expected: expected.to_vec(),
            got: tensor.dims().to_vec(),
        })
    }

    fn numbers(&self, name: &str, expected: &[usize]) -> Result<Vec<f32>, CheckpointError> {
        let tensor = self.get(name, expected)?.to_dtype(DType::F32)?;
        let numbers: Vec<f32> = tensor.flatten_all()?.to_vec1()?;
        match numbers.iter().all(|number| number.is_finite()) {
            true => Ok(numbers),
            false => Err(CheckpointError::NotFinite {
                name: name.to_owned(),
            }),
        }
    }

    fn counters(&self) -> Result<[u64; 2], CheckpointError> {
        let counters: Vec<i64> = self.get(COUNTERS, &[2])?.to_dtype(DType::I64)?.to_vec1()?;
        Ok([counters[0] as u64, counters[1] as u64])
    }
}

/// Tensors like the given ones, with the numbers found under their names behind a prefix.
fn filled<E>(
    like: &Tensors,
    prefix: &str,
    found: &impl Fn(&str, &[usize]) -> Result<Vec<f32>, E>,
) -> Result<Tensors, E> {
    let mut numbers = Vec::with_capacity(like.numbers.len());
    for (name, dims, _) in like.iter() {
        numbers.extend(found(&format!("{prefix}{name}"), dims)?);
    }
    Ok(like.with_numbers(&numbers))
}
