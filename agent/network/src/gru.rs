//! The recurrence of paper eq. 9 over a window.

use crate::ops::gru_sequence::gru_sequence;
use crate::variables::uniform_init;
use candle_core::{Device, Result, Tensor};
use candle_nn::VarBuilder;
use candle_nn::ops::sigmoid;

/// A GRU, gates in torch's order: reset, update, candidate.
#[derive(Debug)]
pub struct Gru {
    w_ih: Tensor,
    w_hh: Tensor,
    b_ih: Tensor,
    b_hh: Tensor,
    is_stock: bool,
}

impl Gru {
    /// A GRU from so many inputs to a hidden vector of some length, of stock operators or ours.
    pub fn new(vb: &VarBuilder<'_>, inputs: usize, hidden: usize, is_stock: bool) -> Result<Self> {
        let (gates, init) = (3 * hidden, uniform_init(hidden));
        Ok(Self {
            w_ih: vb.get_with_hints((gates, inputs), "weight_ih_l0", init)?,
            w_hh: vb.get_with_hints((gates, hidden), "weight_hh_l0", init)?,
            b_ih: vb.get_with_hints(gates, "bias_ih_l0", init)?,
            b_hh: vb.get_with_hints(gates, "bias_hh_l0", init)?,
            is_stock,
        })
    }

    /// The hidden vectors after each of the inputs `[steps, inputs]`, `[steps, hidden]`; `first` is the one
    /// before them.
    pub fn forward(&self, x: &Tensor, first: &[f32]) -> Result<Tensor> {
        let inputs = x.matmul(&self.w_ih.t()?)?.broadcast_add(&self.b_ih)?;
        if self.is_stock {
            return self.stock(&inputs, first);
        }
        // On other devices too: a thousand steps of a few numbers are a thousand times a dozen launches.
        let cpu = |tensor: &Tensor| tensor.to_device(&Device::Cpu);
        let (w, b) = (cpu(&self.w_hh)?, cpu(&self.b_hh)?);
        gru_sequence(&cpu(&inputs)?, &w, &b, first)?.to_device(x.device())
    }

    fn stock(&self, inputs: &Tensor, first: &[f32]) -> Result<Tensor> {
        let n = first.len();
        let h = Tensor::from_slice(first, (1, n), inputs.device())?;
        let (mut h, mut all) = (h.to_dtype(inputs.dtype())?, Vec::new());
        for step in 0..inputs.dim(0)? {
            let i = inputs.narrow(0, step, 1)?;
            let g = h.matmul(&self.w_hh.t()?)?.broadcast_add(&self.b_hh)?;
            let part = |tensor: &Tensor, part: usize| tensor.narrow(1, part * n, n);
            let r = sigmoid(&(part(&i, 0)? + part(&g, 0)?)?)?;
            let z = sigmoid(&(part(&i, 1)? + part(&g, 1)?)?)?;
            let candidate = (part(&i, 2)? + (r * part(&g, 2)?)?)?.tanh()?;
            h = ((1.0 - &z)? * candidate)?.add(&(z * h)?)?;
            all.push(h.clone());
        }
        Tensor::cat(&all, 0)
    }
}
