//! A GRU over a sequence as one operator. The operator takes the inputs' contributions to the gates, not the inputs
//! themselves.

use super::cpu::{add, add_scaled, derived, numbers};
use candle_core::{Result, Tensor};
use emberwatch_model::vectors::vectorised;

struct Gru {
    n: usize,
    /// `W_hh [3 n, n]`.
    w: Vec<f32>,
    /// `h` before each step, and after the last step.
    h: Vec<f32>,
    /// Intermediate results of each step: r, z, the candidate and `W_hn h + b_hn`.
    steps: Vec<f32>,
}

/// Computes `h` after each step, `[steps, n]`. `first` is `h` before the first step. The other arguments are
/// `W_ih x + b_ih` of all steps `[steps, 3 n]`, `W_hh [3 n, n]` and `b_hh [3 n]`, with the gates in PyTorch's order (r,
/// z, n).
pub(crate) fn gru_sequence(
    inputs: &Tensor,
    w: &Tensor,
    b: &Tensor,
    first: &[f32],
) -> Result<Tensor> {
    let n = first.len();
    let mut gru = Gru {
        n,
        w: numbers(w)?.to_vec(),
        h: first.to_vec(),
        steps: Vec::new(),
    };
    let (x, bias) = (numbers(inputs)?, numbers(b)?);
    vectorised(
        #[inline(always)]
        || gru.forward(&x, &bias),
    );
    let (dims, out) = ((inputs.dim(0)?, n), gru.h[n..].to_vec());
    derived(&[inputs, w, b], dims, out, move |d_out| {
        vectorised(
            #[inline(always)]
            || gru.backward(d_out),
        )
    })
}

impl Gru {
    #[inline(always)]
    fn forward(&mut self, inputs: &[f32], b: &[f32]) {
        let n = self.n;
        let places = 0..self.w.len();
        let columns: Vec<f32> = places
            .map(|at| self.w[at % (3 * n) * n + at / (3 * n)])
            .collect();
        let sigmoid = |x: f32| 1.0 / (1.0 + (-x).exp());
        let (mut h, mut gates) = (self.h.clone(), vec![0.0; 3 * n]);
        for input in inputs.chunks_exact(3 * n) {
            gates.copy_from_slice(b);
            for (h, column) in h.iter().zip(columns.chunks_exact(3 * n)) {
                add_scaled(&mut gates, *h, column);
            }
            let step = self.steps.len();
            self.steps.resize(step + 4 * n, 0.0);
            let step = &mut self.steps[step..];
            for at in 0..2 * n {
                step[at] = sigmoid(input[at] + gates[at]);
            }
            for i in 0..n {
                let (r, z, recurrent) = (step[i], step[n + i], gates[2 * n + i]);
                let candidate = (input[2 * n + i] + r * recurrent).tanh();
                (step[2 * n + i], step[3 * n + i]) = (candidate, recurrent);
                h[i] = (1.0 - z) * candidate + z * h[i];
            }
            self.h.extend_from_slice(&h);
        }
    }

    /// Computes the gradients of `W_ih x + b_ih`, `W_hh` and `b_hh`, concatenated.
    #[inline(always)]
    fn backward(&self, d_out: &[f32]) -> Vec<f32> {
        let n = self.n;
        let mut d_inputs = vec![0.0; 3 * d_out.len()];
        let (mut dw, mut db) = (vec![0.0; self.w.len()], vec![0.0; 3 * n]);
        let (mut dh, mut d_gates) = (vec![0.0; n], vec![0.0; 3 * n]);
        for at in (0..d_out.len() / n).rev() {
            let (h, step) = (&self.h[at * n..][..n], &self.steps[at * 4 * n..][..4 * n]);
            let d_input = &mut d_inputs[at * 3 * n..][..3 * n];
            for i in 0..n {
                let (r, z, candidate) = (step[i], step[n + i], step[2 * n + i]);
                let d = dh[i] + d_out[at * n + i];
                let d_candidate = d * (1.0 - z) * (1.0 - candidate * candidate);
                d_input[i] = d_candidate * step[3 * n + i] * r * (1.0 - r);
                d_input[n + i] = d * (h[i] - candidate) * z * (1.0 - z);
                d_input[2 * n + i] = d_candidate;
                d_gates[2 * n + i] = d_candidate * r;
                dh[i] = d * z;
            }
            d_gates[..2 * n].copy_from_slice(&d_input[..2 * n]);
            add(&mut db, &d_gates);
            for (row, d) in d_gates.iter().enumerate() {
                add_scaled(&mut dw[row * n..][..n], *d, h);
                add_scaled(&mut dh, *d, &self.w[row * n..][..n]);
            }
        }
        [d_inputs, dw, db].concat()
    }
}
