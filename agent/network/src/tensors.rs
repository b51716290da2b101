//! Tensors by name: out as plain numbers, in again, and searched for numbers that are not finite.

use crate::adam::Adam;
use crate::error::NetworkError;
use candle_core::{DType, Result, Tensor};
use std::collections::BTreeMap;

/// Name, shape and row-major numbers.
pub type NamedTensor = (String, Vec<usize>, Vec<f32>);

/// The numbers of a tensor, row-major.
pub(crate) fn numbers_of(tensor: &Tensor) -> Result<Vec<f32>> {
    tensor.to_dtype(DType::F32)?.flatten_all()?.to_vec1()
}

/// Tensors as plain numbers.
pub(crate) fn named<'a>(
    tensors: impl Iterator<Item = (String, &'a Tensor)>,
) -> Result<Vec<NamedTensor>> {
    tensors
        .map(|(name, tensor)| Ok((name, tensor.dims().to_vec(), numbers_of(tensor)?)))
        .collect()
}

/// The name of the first tensor that has a number that is not finite.
pub(crate) fn first_not_finite<'a>(
    mut tensors: impl Iterator<Item = (String, &'a Tensor)>,
) -> Result<Option<String>> {
    tensors
        .find_map(|(name, tensor)| match is_finite(tensor) {
            Ok(true) => None,
            Ok(false) => Some(Ok(name)),
            Err(error) => Some(Err(error)),
        })
        .transpose()
}

/// On any device, with one number copied back: a finite number times zero is zero, any other is not.
fn is_finite(tensor: &Tensor) -> Result<bool> {
    let sum = (tensor * 0.0)?.sum_all()?.to_dtype(DType::F32)?;
    Ok(sum.to_scalar::<f32>()? == 0.0)
}

/// A tensor like another, with the numbers found under its name.
pub(crate) fn restored<E: From<NetworkError>>(
    name: &str,
    like: &Tensor,
    find: &impl Fn(&str, &[usize]) -> std::result::Result<Vec<f32>, E>,
) -> std::result::Result<Tensor, E> {
    let numbers = find(name, like.dims())?;
    let tensor = Tensor::from_vec(numbers, like.dims(), like.device());
    Ok(tensor.map_err(NetworkError::from)?)
}

impl Adam {
    /// The moments as `<prefix>.first.<name>` and `<prefix>.second.<name>`.
    pub(crate) fn tensors(&self, prefix: &str) -> impl Iterator<Item = (String, &Tensor)> {
        self.moments().iter().flat_map(move |(name, moments)| {
            let names = ["first", "second"].map(|which| format!("{prefix}.{which}.{name}"));
            names.into_iter().zip(moments)
        })
    }

    /// Moments of the same variables, found under the names of [`Self::tensors`].
    pub(crate) fn found<E: From<NetworkError>>(
        &self,
        prefix: &str,
        find: &impl Fn(&str, &[usize]) -> std::result::Result<Vec<f32>, E>,
    ) -> std::result::Result<BTreeMap<String, [Tensor; 2]>, E> {
        let moments = self.moments().iter().map(|(name, [first, second])| {
            let found =
                |which: &str, like| restored(&format!("{prefix}.{which}.{name}"), like, find);
            Ok((
                name.clone(),
                [found("first", first)?, found("second", second)?],
            ))
        });
        moments.collect()
    }
}
