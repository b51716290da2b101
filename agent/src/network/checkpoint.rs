//! The autoencoder as named tensors: candle's, and bytes in its safetensors format.
//!
//! Parameters and running statistics go by PyTorch's names, so a checkpoint of the authors' network
//! loads; Adam's moments are `adam.first.<name>` and `adam.second.<name>`. The online state is with
//! them, so that a resumed run goes on bit for bit.

use super::autoencoder::Autoencoder;
use super::parameters::Tensors;
use crate::belief::Belief;
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
    #[error("checkpoint: {0}")]
    Damaged(#[from] candle_core::Error),
    /// A tensor is not there.
    #[error("checkpoint: expected a tensor {name}, got none")]
    Missing {
        /// Its name.
        name: String,
    },
    /// A tensor of another network's size.
    #[error("checkpoint: expected {name} of shape {expected:?}, got {got:?}")]
    Shape {
        /// The tensor.
        name: String,
        /// This network's.
        expected: Vec<usize>,
        /// The checkpoint's.
        got: Vec<usize>,
    },
    /// A tensor no network can work with.
    #[error("checkpoint: expected finite numbers, got one that is not in {name}")]
    NotFinite {
        /// The tensor.
        name: String,
    },
    /// A predictor that is no belief.
    #[error("checkpoint: {0}")]
    Prediction(#[from] crate::belief::BeliefError),
}

impl Autoencoder {
    /// Everything that a resumed run needs but settings and seed, by name.
    ///
    /// # Errors
    /// As candle's, which does not happen for tensors in memory.
    pub fn named_tensors(&self) -> candle_core::Result<Vec<(String, Tensor)>> {
        let mut named = Vec::new();
        let mut add = |name: String, numbers: &[f32], dims: &[usize]| {
            named.push((name, Tensor::from_slice(numbers, dims, &Device::Cpu)?));
            candle_core::Result::Ok(())
        };
        for (name, dims, numbers) in self.parameters.iter().chain(self.statistics.iter()) {
            add(name.to_owned(), numbers, dims)?;
        }
        let moments = [("first", &self.adam.first), ("second", &self.adam.second)];
        for (moment, numbers) in moments {
            for (name, dims, numbers) in self.parameters.with_numbers(numbers).iter() {
                add(format!("adam.{moment}.{name}"), numbers, dims)?;
            }
        }
        add(HIDDEN.to_owned(), &self.hidden, &[self.hidden.len()])?;
        let prediction = self.prediction();
        add(
            PREDICTION.to_owned(),
            prediction.as_slice(),
            prediction.view().shape(),
        )?;
        let counters = [self.adam.step as i64, self.n_updates as i64];
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
        let parameters = tensors.filled(&self.parameters, "")?;
        let statistics = tensors.filled(&self.statistics, "")?;
        let first = tensors.filled(&self.parameters, "adam.first.")?;
        let second = tensors.filled(&self.parameters, "adam.second.")?;
        let hidden = tensors.numbers(HIDDEN, &[self.hidden.len()])?;
        let dims = self.prediction().view().shape().to_vec();
        let prediction = tensors.numbers(PREDICTION, &dims)?;
        let prediction = Array::from_shape_vec((dims[0], dims[1], dims[2]), prediction);
        let prediction = prediction.expect("invariant: the tensor has this shape");
        let prediction = Belief::from_probabilities(prediction)?;
        let [step, n_updates] = tensors.counters()?;
        *self.parameters_mut() = parameters;
        self.statistics = statistics;
        (self.adam.first, self.adam.second) = (first.numbers, second.numbers);
        (self.adam.step, self.n_updates) = (step, n_updates);
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
        let parameters = tensors.filled(&self.parameters, "")?;
        self.statistics = tensors.filled(&self.statistics, "")?;
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

    /// Tensors like the given ones, with the numbers stored under their names behind a prefix.
    fn filled(&self, like: &Tensors, prefix: &str) -> Result<Tensors, CheckpointError> {
        let mut numbers = Vec::with_capacity(like.numbers.len());
        for (name, dims, _) in like.iter() {
            numbers.extend(self.numbers(&format!("{prefix}{name}"), dims)?);
        }
        Ok(like.with_numbers(&numbers))
    }

    fn counters(&self) -> Result<[u64; 2], CheckpointError> {
        let counters: Vec<i64> = self.get(COUNTERS, &[2])?.to_dtype(DType::I64)?.to_vec1()?;
        Ok([counters[0] as u64, counters[1] as u64])
    }
}
