//! A GRU over a sequence as one operator, from what its inputs add to the gates.

use super::cpu::{add, add_scaled, dot, numbers, slice, tensor};
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor};
use protocol::vectors::vectorised;

/// Arguments: `W_ih x + b_ih` of all steps `[steps, 3 n]`, `W_hh [3 n, n]` and `b_hh [3 n]`, gates in torch's
/// order (r, z, n). The result is `h` of all steps, `[steps, n]`.
pub(crate) struct GruSequence {
    /// `h` before the first step.
    pub(crate) first: Vec<f32>,
}

/// What one step computes.
struct Step {
    r: Vec<f32>,
    z: Vec<f32>,
    candidate: Vec<f32>,
    /// `W_hn h + b_hn`.
    recurrent: Vec<f32>,
}

#[derive(Clone, Copy)]
struct Weights<'a> {
    w: &'a [f32],
    b: &'a [f32],
}

impl Weights<'_> {
    #[inline(always)]
    fn step(&self, input: &[f32], h: &[f32]) -> Step {
        let n = h.len();
        let product = |row: usize| self.b[row] + dot(&self.w[row * n..][..n], h);
        let sigmoid = |x: f32| 1.0 / (1.0 + (-x).exp());
        let gate = |row: usize| sigmoid(input[row] + product(row));
        let r: Vec<f32> = (0..n).map(gate).collect();
        let recurrent: Vec<f32> = (2 * n..3 * n).map(product).collect();
        let candidate = |i: usize| (input[2 * n + i] + r[i] * recurrent[i]).tanh();
        Step {
            z: (n..2 * n).map(gate).collect(),
            candidate: (0..n).map(candidate).collect(),
            r,
            recurrent,
        }
    }
}

impl GruSequence {
    #[inline(always)]
    fn forward(&self, inputs: &[f32], weights: Weights<'_>) -> Vec<f32> {
        let n = self.first.len();
        let (mut h, mut out) = (self.first.clone(), Vec::with_capacity(inputs.len() / 3));
        for input in inputs.chunks_exact(3 * n) {
            let step = weights.step(input, &h);
            for ((h, z), candidate) in h.iter_mut().zip(&step.z).zip(&step.candidate) {
                *h = (1.0 - z) * candidate + z * *h;
            }
            out.extend_from_slice(&h);
        }
        out
    }

    /// Gradients of the inputs, `W_hh` and `b_hh`.
    #[inline(always)]
    fn backward(
        &self,
        inputs: &[f32],
        weights: Weights<'_>,
        out: &[f32],
        d_out: &[f32],
    ) -> [Vec<f32>; 3] {
        let n = self.first.len();
        let mut d_inputs = vec![0.0; inputs.len()];
        let (mut dw, mut db) = (vec![0.0; weights.w.len()], vec![0.0; 3 * n]);
        let (mut dh, mut d_gates) = (vec![0.0; n], vec![0.0; 3 * n]);
        for at in (0..out.len() / n).rev() {
            let before = at.checked_sub(1);
            let h = before.map_or(&self.first[..], |before| &out[before * n..][..n]);
            let step = weights.step(&inputs[at * 3 * n..][..3 * n], h);
            let d_input = &mut d_inputs[at * 3 * n..][..3 * n];
            for i in 0..n {
                let (r, z, candidate) = (step.r[i], step.z[i], step.candidate[i]);
                let d = dh[i] + d_out[at * n + i];
                let d_candidate = d * (1.0 - z) * (1.0 - candidate * candidate);
                d_input[i] = d_candidate * step.recurrent[i] * r * (1.0 - r);
                d_input[n + i] = d * (h[i] - candidate) * z * (1.0 - z);
                d_input[2 * n + i] = d_candidate;
                d_gates[2 * n + i] = d_candidate * r;
                dh[i] = d * z;
            }
            d_gates[..2 * n].copy_from_slice(&d_input[..2 * n]);
            add(&mut db, &d_gates);
            for (row, d) in d_gates.iter().enumerate() {
                add_scaled(&mut dw[row * n..][..n], *d, h);
                add_scaled(&mut dh, *d, &weights.w[row * n..][..n]);
            }
        }
        [d_inputs, dw, db]
    }
}

impl CustomOp3 for GruSequence {
    fn name(&self) -> &'static str {
        "gru-sequence"
    }

    fn cpu_fwd(
        &self,
        inputs: &CpuStorage,
        inputs_layout: &Layout,
        w: &CpuStorage,
        w_layout: &Layout,
        b: &CpuStorage,
        b_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let inputs = slice(inputs, inputs_layout)?;
        let weights = Weights {
            w: slice(w, w_layout)?,
            b: slice(b, b_layout)?,
        };
        let out = vectorised(
            #[inline(always)]
            || self.forward(inputs, weights),
        );
        let n_steps = inputs_layout.dims()[0];
        Ok((CpuStorage::F32(out), (n_steps, self.first.len()).into()))
    }

    fn bwd(
        &self,
        inputs: &Tensor,
        w: &Tensor,
        b: &Tensor,
        out: &Tensor,
        d_out: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let d_out = d_out.contiguous()?;
        let (x, out, d_out) = (numbers(inputs)?, numbers(out)?, numbers(&d_out)?);
        let arguments = [numbers(w)?, numbers(b)?];
        let weights = Weights {
            w: &arguments[0],
            b: &arguments[1],
        };
        let [d_inputs, dw, db] = vectorised(
            #[inline(always)]
            || self.backward(&x, weights, &out, &d_out),
        );
        Ok((
            Some(tensor(d_inputs, inputs.shape())?),
            Some(tensor(dw, w.shape())?),
            Some(tensor(db, b.shape())?),
        ))
    }
}
