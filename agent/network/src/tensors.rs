//! Tensors by name: out as plain numbers, in again, and searched for numbers that are not finite.

use crate::error::NetworkError;
use crate::variables::Variables;
use candle_core::{DType, Result, Tensor, Var};

/// Name, shape and row-major numbers.
pub type NamedTensor = (String, Vec<usize>, Vec<f32>);

/// A variable's name, the variable, and what it becomes.
pub(crate) type Change = (String, Var, Tensor);

/// Groups of variables, with what their names are preceded by in a checkpoint.
pub(crate) type Groups<'a> = &'a [(&'static str, &'a Variables)];

/// The numbers of a tensor, row-major.
pub(crate) fn numbers_of(tensor: &Tensor) -> Result<Vec<f32>> {
    tensor.to_dtype(DType::F32)?.flatten_all()?.to_vec1()
}

/// All variables, by their names in a checkpoint.
pub(crate) fn named<'a>(groups: Groups<'a>) -> impl Iterator<Item = (String, &'a Tensor)> {
    groups.iter().flat_map(|(prefix, variables)| {
        let variables = variables.iter();
        variables.map(move |(name, var)| (format!("{prefix}{name}"), var.as_tensor()))
    })
}

/// All variables as plain numbers.
pub(crate) fn named_numbers(groups: Groups<'_>) -> Result<Vec<NamedTensor>> {
    named(groups)
        .map(|(name, tensor)| Ok((name, tensor.dims().to_vec(), numbers_of(tensor)?)))
        .collect()
}

/// What all variables become with the numbers that `find` gives for a name and shape.
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

/// Changes variables.
pub(crate) fn set(changes: &[Change]) -> Result<()> {
    changes
        .iter()
        .try_for_each(|(_, var, tensor)| var.set(tensor))
}

/// One number of each tensor, zero if all of its own are finite: a finite number times zero is zero, any other is not.
pub(crate) fn zero_if_finite(tensor: &Tensor) -> Result<Tensor> {
    (tensor * 0.0)?.sum_all()
}

/// Scalars as numbers, with one copy from their device: each copy waits for all that was asked of it.
pub(crate) fn copied(scalars: &[Tensor]) -> Result<Vec<f32>> {
    let scalars = scalars.iter().map(|scalar| scalar.to_dtype(DType::F32));
    Tensor::stack(&scalars.collect::<Result<Vec<_>>>()?, 0)?.to_vec1()
}
