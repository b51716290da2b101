//! Batch normalisation, which uses the moments of the window in training, and running statistics otherwise.

use crate::ops::norm::{EPSILON, Moments};
use crate::pass::{KeptMoments, Pass};
use crate::tensors::Change;
use crate::variables::Variables;
use candle_core::{DType, Device, Result, Tensor};
use candle_nn::{Init, VarBuilder};

/// Weight of a new window in the moving averages of the running statistics, as in PyTorch.
const MOMENTUM: f64 = 0.1;

#[derive(Debug)]
pub(crate) struct BatchNorm {
    name: String,
    gamma: Tensor,
    beta: Tensor,
    mean: Tensor,
    variance: Tensor,
}

impl BatchNorm {
    pub(crate) fn new(vb: &VarBuilder<'_>, channels: usize) -> Result<Self> {
        let get = |name: &str, value: f64| vb.get_with_hints(channels, name, Init::Const(value));
        Ok(Self {
            name: vb.prefix(),
            gamma: get("weight", 1.0)?,
            beta: get("bias", 0.0)?,
            mean: get("running_mean", 0.0)?,
            variance: get("running_var", 1.0)?,
        })
    }

    pub(crate) fn weights(&self) -> [&Tensor; 2] {
        [&self.gamma, &self.beta]
    }

    /// In training, these are the moments of the window, which are also stored in the pass.
    pub(crate) fn moments(&self, pass: &Pass<'_>, of_window: Moments) -> Result<Moments> {
        if !pass.trains() {
            return Ok(Moments {
                mean: exact(&self.mean)?,
                variance: exact(&self.variance)?,
                // With an infinite count, no gradient propagates through the moments.
                count: f64::INFINITY,
            });
        }
        let tensor = |numbers: &[f64]| Tensor::new(numbers, &Device::Cpu);
        let moments = [&of_window.mean, &of_window.variance].map(|numbers| tensor(numbers));
        let [mean, variance] = moments;
        pass.keep_moments(&self.name, [mean?, variance?], of_window.count);
        Ok(of_window)
    }

    pub(crate) fn forward(&self, u: &Tensor, pass: &Pass<'_>) -> Result<Tensor> {
        let channels = u.dim(1)?;
        let per_channel = |tensor: &Tensor| tensor.reshape((1, channels, 1, 1));
        let (mean, variance) = if pass.trains() {
            let flat = u.transpose(0, 1)?.flatten_from(1)?;
            let mean = flat.mean_keepdim(1)?;
            let variance = flat.broadcast_sub(&mean)?.sqr()?.mean_keepdim(1)?;
            let moments = [mean.flatten_all()?, variance.flatten_all()?];
            pass.keep_moments(&self.name, moments, flat.dim(1)? as f64);
            (mean, variance)
        } else {
            (self.mean.clone(), self.variance.clone())
        };
        let deviation = (variance + EPSILON)?.sqrt()?;
        u.broadcast_sub(&per_channel(&mean)?)?
            .broadcast_div(&per_channel(&deviation)?)?
            .broadcast_mul(&per_channel(&self.gamma)?)?
            .broadcast_add(&per_channel(&self.beta)?)
    }
}

fn exact(tensor: &Tensor) -> Result<Vec<f64>> {
    tensor.flatten_all()?.to_dtype(DType::F64)?.to_vec1()
}

pub(crate) fn moved_statistics(
    variables: &Variables,
    moments: &[KeptMoments],
) -> Result<Vec<Change>> {
    let mut moved = Vec::with_capacity(2 * moments.len());
    for kept in moments {
        let [mean, variance] = &kept.moments;
        // PyTorch stores the sample variance, which is divided by the number of values minus one.
        let variance = (variance * (kept.count / (kept.count - 1.0).max(1.0)))?;
        for (what, new) in [("running_mean", mean), ("running_var", &variance)] {
            let name = format!("{}.{what}", kept.norm);
            let old = &variables[&name];
            let new = new.to_dtype(old.dtype())?;
            let now = ((old.as_detached_tensor() * (1.0 - MOMENTUM))? + (new * MOMENTUM)?)?;
            moved.push((format!("{name} after the update"), old.clone(), now));
        }
    }
    Ok(moved)
}
