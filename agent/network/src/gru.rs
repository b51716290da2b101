//! The recurrence of paper eq. 9, a GRU that runs over the frames of a window.

use crate::operators::Operators;
use crate::ops::gru_sequence::gru_sequence;
use crate::variables::uniform_init;
use candle_core::{DType, Device, Result, Tensor};
use candle_nn::VarBuilder;
use candle_nn::ops::sigmoid;

/// A GRU with the gates in PyTorch's order: reset, update, candidate.
#[derive(Debug)]
pub struct Gru {
    w_ih: Tensor,
    w_hh: Tensor,
    b_ih: Tensor,
    b_hh: Tensor,
    operators: Operators,
}

impl Gru {
    /// Creates a GRU with the given input and hidden sizes.
    pub fn new(
        vb: &VarBuilder<'_>,
        inputs: usize,
        hidden: usize,
        operators: Operators,
    ) -> Result<Self> {
        let (gates, init) = (3 * hidden, uniform_init(hidden));
        Ok(Self {
            w_ih: vb.get_with_hints((gates, inputs), "weight_ih_l0", init)?,
            w_hh: vb.get_with_hints((gates, hidden), "weight_hh_l0", init)?,
            b_ih: vb.get_with_hints(gates, "bias_ih_l0", init)?,
            b_hh: vb.get_with_hints(gates, "bias_hh_l0", init)?,
            operators,
        })
    }

    /// Computes the hidden vector after each input, `[steps, hidden]`, from inputs `[steps, inputs]`. `first` is the
    /// hidden vector before the first input.
    ///
    /// # Panics
    /// If `first` has the wrong length.
    pub fn forward(&self, x: &Tensor, first: &[f32]) -> Result<Tensor> {
        assert_eq!(
            first.len(),
            self.w_hh.dim(1)?,
            "hidden vector: expected the GRU's length"
        );
        let inputs = x.matmul(&self.w_ih.t()?)?.broadcast_add(&self.b_ih)?;
        match (self.operators, inputs.dtype()) {
            (Operators::Own, _) => gru_sequence(&inputs, &self.w_hh, &self.b_hh, first),
            (Operators::Stock, DType::F32) => self.through_the_cpu(&inputs, first),
            (Operators::Stock, _) => self.step_by_step(&inputs, first),
        }
    }

    fn through_the_cpu(&self, inputs: &Tensor, first: &[f32]) -> Result<Tensor> {
        let all = [inputs, &self.w_hh, &self.b_hh];
        let flat = all.map(|tensor| tensor.flatten_all());
        let flat = flat.into_iter().collect::<Result<Vec<_>>>()?;
        let flat = Tensor::cat(&flat, 0)?.to_device(&Device::Cpu)?;
        let mut start = 0;
        let [inputs, w, b] = all.map(|like| {
            let part = flat.narrow(0, start, like.elem_count())?;
            start += like.elem_count();
            part.reshape(like.shape())
        });
        gru_sequence(&inputs?, &w?, &b?, first)?.to_device(self.w_hh.device())
    }

    fn step_by_step(&self, inputs: &Tensor, first: &[f32]) -> Result<Tensor> {
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
