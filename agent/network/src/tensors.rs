//! Named tensors: conversion to and from plain numbers, and the check that all numbers are finite.

use crate::error::NetworkError;
use crate::variables::Variables;
use candle_core::{DType, Result, Tensor, Var};

/// Name, shape and row-major numbers.
pub type NamedTensor = (String, Vec<usize>, Vec<f32>);

pub(crate) type Change = (String, Var, Tensor);

/// Groups of variables, each with the prefix of its names in a checkpoint.
pub(crate) type Groups<'a> = &'a [(&'static str, &'a Variables)];

pub(crate) fn numbers_of(tensor: &Tensor) -> Result<Vec<f32>> {
    tensor.to_dtype(DType::F32)?.flatten_all()?.to_vec1()
}

pub(crate) fn named<'a>(groups: Groups<'a>) -> impl Iterator<Item = (String, &'a Tensor)> {
    groups.iter().flat_map(|(prefix, variables)| {
        let variables = variables.iter();
        variables.map(move |(name, var)| (format!("{prefix}{name}"), var.as_tensor()))
    })
}

pub(crate) fn named_numbers(groups: Groups<'_>) -> Result<Vec<NamedTensor>> {
    named(groups)
        .map(|(name, tensor)| Ok((name, tensor.dims().to_vec(), numbers_of(tensor)?)))
        .collect()
}

pub(crate) fn found<E: From<NetworkError>>(
    groups: Groups<'_>,
    find: impl Fn(&str, &[usize]) -> std::result::Result<Vec<f32>, E>,
) -> std::result::Result<Vec<Change>, E> {
    let variables = groups.iter().flat_map(|(_, variables)| variables.values());
    let change = |((name, _), var): ((String, _), &Var)| {
        let tensor = Tensor::from_vec(find(&name, var.dims())?, var.dims(), var.device());
        Ok((name, var.clone(), tensor.map_err(NetworkError::from)?))
    };
    named(groups).zip(variables).map(change).collect()
}

pub(crate) fn set(changes: &[Change]) -> Result<()> {
    changes
        .iter()
        .try_for_each(|(_, var, tensor)| var.set(tensor))
}

/// Returns a scalar that is 0 if all values of a tensor are finite, and NaN otherwise: the sum of all values times 0.
pub(crate) fn zero_if_finite(tensor: &Tensor) -> Result<Tensor> {
    (tensor * 0.0)?.sum_all()
}

/// Copies scalars from their device in one copy, because each copy waits until the device has finished its queue.
pub(crate) fn copied(scalars: &[Tensor]) -> Result<Vec<f32>> {
    let scalars = scalars.iter().map(|scalar| scalar.to_dtype(DType::F32));
    Tensor::stack(&scalars.collect::<Result<Vec<_>>>()?, 0)?.to_vec1()
}
