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
