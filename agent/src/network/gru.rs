//! The recurrence `h_{k+1} = RNN(h_k, Encoder(y_k))` of paper eq. 9: a GRU over a whole window.
//!
//! With `i = W_ih e + b_ih` and `g = W_hh h + b_hh`, each in three parts r, z, n, as PyTorch has them:
//! `r = sigmoid(i_r + g_r)`, `z = sigmoid(i_z + g_z)`, `n = tanh(i_n + r g_n)`, `h' = (1 - z) n + z h`.

use super::lanes::{Arithmetic, Kernel};
use super::parameters::Tensors;

/// A GRU's weights, transposed: one row of `3 hidden` gate inputs per input.
#[derive(Debug)]
pub(crate) struct Gru {
    encoding: usize,
    hidden: usize,
    from_encoding: Vec<f32>,
    from_hidden: Vec<f32>,
    bias_encoding: Vec<f32>,
    bias_hidden: Vec<f32>,
}

/// What the backward pass needs of one step: r, z, n and g_n, each `hidden` long.
const SAVED: usize = 4;

/// The states of a window, and what the backward pass needs.
#[derive(Debug, Default)]
pub(crate) struct Trace {
    /// `h_0 .. h_K`.
    pub(crate) hidden: Vec<f32>,
    saved: Vec<f32>,
}

impl Gru {
    pub(crate) fn new(parameters: &Tensors, encoding: usize, hidden: usize) -> Self {
        let tensor = |what: &str| parameters.get(&format!("rnn_layer.{what}_l0"));
        Self {
            encoding,
            hidden,
            from_encoding: transposed(tensor("weight_ih"), encoding),
            from_hidden: transposed(tensor("weight_hh"), hidden),
            bias_encoding: tensor("bias_ih").to_vec(),
            bias_hidden: tensor("bias_hh").to_vec(),
        }
    }

    /// All states from `h_0` and the encodings, one row each.
    #[inline(always)]
    pub(crate) fn forward<A: Arithmetic>(&self, first: &[f32], encodings: &[f32]) -> Trace {
        let n = self.hidden;
        let mut trace = Trace::default();
        trace.hidden.extend_from_slice(first);
        let mut gates = [vec![0.0; 3 * n], vec![0.0; 3 * n]];
        for encoding in encodings.chunks_exact(self.encoding) {
            let hidden = trace.hidden[trace.hidden.len() - n..].to_vec();
            let [from_encoding, from_hidden] = &mut gates;
            from_encoding.copy_from_slice(&self.bias_encoding);
            from_hidden.copy_from_slice(&self.bias_hidden);
            add_rows::<A>(from_encoding, encoding, &self.from_encoding);
            add_rows::<A>(from_hidden, &hidden, &self.from_hidden);
            let saved = trace.saved.len();
            trace.saved.resize(saved + SAVED * n, 0.0);
            for unit in 0..n {
                let (i, g) = (&from_encoding, &from_hidden);
                let r = sigmoid(i[unit] + g[unit]);
                let z = sigmoid(i[n + unit] + g[n + unit]);
                let candidate = (i[2 * n + unit] + r * g[2 * n + unit]).tanh();
                trace.hidden.push((1.0 - z) * candidate + z * hidden[unit]);
                for (part, value) in [r, z, candidate, g[2 * n + unit]].into_iter().enumerate() {
                    trace.saved[saved + part * n + unit] = value;
                }
            }
        }
        trace
    }

    /// From the gradients of `h_1 .. h_K` to those of the encodings (returned) and the parameters.
    #[inline(always)]
    pub(crate) fn backward<A: Arithmetic>(
        &self,
        trace: &Trace,
        encodings: &[f32],
        d_hidden: &[f32],
        gradient: &mut Tensors,
    ) -> Vec<f32> {
        let n = self.hidden;
        let mut d_encodings = vec![0.0; encodings.len()];
        let mut sums = GruGradient::zeros(self);
        let mut d_next = vec![0.0; n];
        for step in (0..d_hidden.len() / n).rev() {
            let before = &trace.hidden[step * n..][..n];
            let encoding = step * self.encoding..(step + 1) * self.encoding;
            for (d, later) in d_next.iter_mut().zip(&d_hidden[step * n..]) {
                *d += later;
            }
            let saved = &trace.saved[SAVED * step * n..][..SAVED * n];
            let d_gates = gate_gradients(saved, before, &mut d_next);
            sums.add::<A>(&d_gates, &encodings[encoding.clone()], before);
            let [d_from_encoding, d_from_hidden] = &d_gates;
            products::<A>(
                d_from_encoding,
                &self.from_encoding,
                &mut d_encodings[encoding],
            );
            products::<A>(d_from_hidden, &self.from_hidden, &mut d_next);
        }
        sums.write(self, gradient);
        d_encodings
    }
}

/// Gradients of the gate inputs from the encoding and from the hidden state; `d_hidden` becomes the part
/// of the previous state's gradient that does not go through the gates.
#[inline(always)]
fn gate_gradients(saved: &[f32], before: &[f32], d_hidden: &mut [f32]) -> [Vec<f32>; 2] {
    let n = before.len();
    let mut d_from_encoding = vec![0.0; 3 * n];
    let mut d_from_hidden = vec![0.0; 3 * n];
    for unit in 0..n {
        let [r, z, candidate, g] = [0, 1, 2, 3].map(|part| saved[part * n + unit]);
        let d = d_hidden[unit];
        let d_candidate = d * (1.0 - z) * (1.0 - candidate * candidate);
        let d_r = d_candidate * g * r * (1.0 - r);
        let d_z = d * (before[unit] - candidate) * z * (1.0 - z);
        for (part, value) in [d_r, d_z, d_candidate].into_iter().enumerate() {
            d_from_encoding[part * n + unit] = value;
        }
        for (part, value) in [d_r, d_z, d_candidate * r].into_iter().enumerate() {
            d_from_hidden[part * n + unit] = value;
        }
        d_hidden[unit] = d * z;
    }
    [d_from_encoding, d_from_hidden]
}

/// Gradients of the parameters, in the transposed layout of [`Gru`].
struct GruGradient {
    from_encoding: Vec<f32>,
    from_hidden: Vec<f32>,
    bias: [Vec<f32>; 2],
}

impl GruGradient {
    fn zeros(gru: &Gru) -> Self {
        Self {
            from_encoding: vec![0.0; gru.from_encoding.len()],
            from_hidden: vec![0.0; gru.from_hidden.len()],
            bias: [vec![0.0; 3 * gru.hidden], vec![0.0; 3 * gru.hidden]],
        }
    }

    #[inline(always)]
    fn add<A: Arithmetic>(&mut self, d_gates: &[Vec<f32>; 2], encoding: &[f32], hidden: &[f32]) {
        let [d_from_encoding, d_from_hidden] = d_gates;
        add_outer::<A>(&mut self.from_encoding, encoding, d_from_encoding);
        add_outer::<A>(&mut self.from_hidden, hidden, d_from_hidden);
        for (bias, d_gates) in self.bias.iter_mut().zip(d_gates) {
            for (bias, d) in bias.iter_mut().zip(d_gates) {
                *bias += d;
            }
        }
    }

    fn write(&self, gru: &Gru, gradient: &mut Tensors) {
        let mut set = |what: &str, numbers: &[f32]| {
            gradient
                .get_mut(&format!("rnn_layer.{what}_l0"))
                .copy_from_slice(numbers);
        };
        let gates = 3 * gru.hidden;
        set("weight_ih", &transposed(&self.from_encoding, gates));
        set("weight_hh", &transposed(&self.from_hidden, gates));
        set("bias_ih", &self.bias[0]);
        set("bias_hh", &self.bias[1]);
    }
}

/// `sums += sum over i of x_i row_i`.
#[inline(always)]
fn add_rows<A: Arithmetic>(sums: &mut [f32], x: &[f32], rows: &[f32]) {
    for (x, row) in x.iter().zip(rows.chunks_exact(sums.len())) {
        for (sum, weight) in sums.iter_mut().zip(row) {
            *sum = A::mul_add(*x, *weight, *sum);
        }
    }
}

/// `row_i += x_i d`.
#[inline(always)]
fn add_outer<A: Arithmetic>(rows: &mut [f32], x: &[f32], d: &[f32]) {
    for (x, row) in x.iter().zip(rows.chunks_exact_mut(d.len())) {
        for (weight, d) in row.iter_mut().zip(d) {
            *weight = A::mul_add(*x, *d, *weight);
        }
    }
}

/// `sums_i += row_i . d`.
#[inline(always)]
fn products<A: Arithmetic>(d: &[f32], rows: &[f32], sums: &mut [f32]) {
    for (sum, row) in sums.iter_mut().zip(rows.chunks_exact(d.len())) {
        *sum += super::lanes::sum_and_product::<A>(row, d).1;
    }
}

/// The transpose of a matrix with `columns` columns.
fn transposed(matrix: &[f32], columns: usize) -> Vec<f32> {
    let rows = matrix.len() / columns;
    let entries = 0..matrix.len();
    entries
        .map(|index| matrix[index % rows * columns + index / rows])
        .collect()
}

fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}

/// [`Gru::forward`] as a kernel.
pub(crate) struct Forward<'a> {
    pub(crate) gru: &'a Gru,
    pub(crate) first: &'a [f32],
    pub(crate) encodings: &'a [f32],
    pub(crate) trace: &'a mut Trace,
}

impl Kernel for Forward<'_> {
    #[inline(always)]
    fn run<A: Arithmetic>(self) {
        *self.trace = self.gru.forward::<A>(self.first, self.encodings);
    }
}

/// [`Gru::backward`] as a kernel.
pub(crate) struct Backward<'a> {
    pub(crate) gru: &'a Gru,
    pub(crate) trace: &'a Trace,
    pub(crate) encodings: &'a [f32],
    pub(crate) d_hidden: &'a [f32],
    pub(crate) d_encodings: &'a mut Vec<f32>,
    pub(crate) gradient: &'a mut Tensors,
}

impl Kernel for Backward<'_> {
    #[inline(always)]
    fn run<A: Arithmetic>(self) {
        let Self {
            trace, encodings, ..
        } = self;
        *self.d_encodings = self
            .gru
            .backward::<A>(trace, encodings, self.d_hidden, self.gradient);
    }
}
