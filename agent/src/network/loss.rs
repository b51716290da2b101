//! The loss of paper eqs. 8 and 11 at single cells, sixteen at once.
//!
//! At a visited cell the predictor is `u = softmax(logits)`, the predicted observation `q = O u` with
//! each column of `O` a softmax, and the loss the binary cross-entropy of all O channels:
//! `-log q_y - sum over a != y of log(1 - q_a)`.

use super::lanes::{Arithmetic, LANES, Lanes};
use super::window::Window;
use protocol::frame::UNOBSERVED;
use serde::{Deserialize, Serialize};

/// What the sum over a window's visited cells is divided by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LossKind {
    /// Their number, as in the authors' code.
    MeanOfCells,
    /// The number K of predicted frames (eqs. 8 and 11).
    SumOfCells,
}

/// Settings of the loss.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LossSettings {
    /// What the sum over cells is divided by.
    pub kind: LossKind,
    /// Added inside logarithms. With 0 they are exact, and the loss infinite where a probability is
    /// rounded to 0 or 1.
    pub log_floor: f32,
}

impl LossSettings {
    /// What the authors ran.
    pub fn paper() -> Self {
        Self {
            kind: LossKind::MeanOfCells,
            log_floor: 1e-10,
        }
    }

    /// What the sum over a window's visited cells is divided by.
    pub(crate) fn divisor(&self, window: &Window) -> usize {
        match self.kind {
            LossKind::MeanOfCells => window.n_targets(),
            LossKind::SumOfCells => window.len() - 1,
        }
    }
}

/// The observation matrix, and its gradient so far.
#[derive(Debug, Clone)]
pub(crate) struct CellLoss {
    n_states: usize,
    /// `[observation][state]`; columns sum to one.
    observation: Vec<f32>,
    /// One divided by [`LossSettings::divisor`].
    weight: f32,
    log_floor: f32,
    d_observation: Vec<f64>,
    loss: f64,
    /// Room for `u` and its gradient.
    u: Vec<Lanes>,
    d_u: Vec<Lanes>,
}

impl CellLoss {
    /// From the matrix before its softmax, `[O, S]`, and what the sum over cells is divided by; with the
    /// authors' floor under logarithms.
    pub(crate) fn new(parameters: &[f32], n_states: usize, divisor: usize) -> Self {
        let observation = softmax_of_columns(parameters, n_states);
        Self {
            n_states,
            d_observation: vec![0.0; observation.len()],
            observation,
            weight: 1.0 / divisor.max(1) as f32,
            log_floor: LossSettings::paper().log_floor,
            loss: 0.0,
            u: vec![Lanes::ZERO; n_states],
            d_u: vec![Lanes::ZERO; n_states],
        }
    }

    /// Adds another number inside logarithms.
    pub(crate) fn with_log_floor(self, log_floor: f32) -> Self {
        Self { log_floor, ..self }
    }

    /// The sum of the losses so far, before division.
    pub(crate) fn sum(&self) -> f64 {
        self.loss
    }

    /// Adds sixteen cells of observed `values` and turns their logits, one `Lanes` per state, into
    /// gradients. Cells that are not observed add nothing.
    #[inline(always)]
    pub(crate) fn add<A: Arithmetic>(&mut self, logits: &mut [Lanes], values: &[u8; LANES]) {
        let seen = values.map(|value| value != UNOBSERVED);
        softmax::<A>(logits, &mut self.u);
        self.d_u.fill(Lanes::ZERO);
        let mut likelihood = [1.0; LANES];
        for observed in 0..self.observation.len() / self.n_states {
            let row = observed * self.n_states..(observed + 1) * self.n_states;
            let mut q = Lanes::ZERO;
            for (u, entry) in self.u.iter().zip(&self.observation[row.clone()]) {
                q = q.add_scaled::<A>(*entry, *u);
            }
            let mut d_q = Lanes::ZERO;
            for lane in 0..LANES {
                let hit = usize::from(values[lane]) == observed;
                // Rounding may take q above one.
                let miss = (1.0 - q.0[lane]).max(0.0);
                let term = self.log_floor + if hit { q.0[lane] } else { miss };
                likelihood[lane] *= term;
                let slope = if hit { -self.weight } else { self.weight };
                d_q.0[lane] = if seen[lane] { slope / term } else { 0.0 };
            }
            for (state, index) in row.enumerate() {
                let d_u = &mut self.d_u[state];
                *d_u = d_u.add_scaled::<A>(self.observation[index], d_q);
                let d = Lanes::ZERO.add_product::<A>(d_q, self.u[state]).sum();
                self.d_observation[index] += f64::from(d);
            }
        }
        for lane in 0..LANES {
            if seen[lane] {
                // One logarithm a cell. At most one factor other than q_y is near zero, as the q sum to
                // one, and 6e-8 or more unless it is zero, so the product underflows only where q_y all
                // but does.
                self.loss -= f64::from(likelihood[lane].ln());
            }
        }
        softmax_gradient::<A>(&self.u, &self.d_u, logits);
    }

    /// The sum of the gradients of some chunks with respect to the matrix before its softmax.
    pub(crate) fn gradient<'a>(chunks: impl Iterator<Item = &'a Self>) -> Vec<f32> {
        let chunks: Vec<&Self> = chunks.collect();
        let (n_states, matrix) = (chunks[0].n_states, &chunks[0].observation);
        let d_matrix: Vec<f64> = (0..matrix.len())
            .map(|index| chunks.iter().map(|chunk| chunk.d_observation[index]).sum())
            .collect();
        let entry = |index: usize| {
            let column = (index % n_states..matrix.len()).step_by(n_states);
            let mean: f64 = column.map(|at| f64::from(matrix[at]) * d_matrix[at]).sum();
            (f64::from(matrix[index]) * (d_matrix[index] - mean)) as f32
        };
        (0..matrix.len()).map(entry).collect()
    }
}

/// The observation matrix: each column, the observations of one state, sums to one.
pub(crate) fn softmax_of_columns(parameters: &[f32], n_states: usize) -> Vec<f32> {
    let column = |state: usize| parameters.iter().skip(state).step_by(n_states);
    let largest = |state| column(state).fold(f32::MIN, |largest, &p| largest.max(p));
    let exps: Vec<f32> = parameters
        .iter()
        .enumerate()
        .map(|(index, p)| (p - largest(index % n_states)).exp())
        .collect();
    let total = |state: usize| exps.iter().skip(state).step_by(n_states).sum::<f32>();
    let totals: Vec<f32> = (0..n_states).map(total).collect();
    let entries = exps.iter().enumerate();
    entries
        .map(|(index, exp)| exp / totals[index % n_states])
        .collect()
}

/// `u = softmax(logits)` in each lane.
#[inline(always)]
pub(crate) fn softmax<A: Arithmetic>(logits: &[Lanes], u: &mut [Lanes]) {
    let mut largest = [f32::MIN; LANES];
    for logits in logits {
        for (largest, logit) in largest.iter_mut().zip(logits.0) {
            *largest = largest.max(logit);
        }
    }
    let mut total = Lanes::ZERO;
    for (u, logits) in u.iter_mut().zip(logits) {
        for (u, (logit, largest)) in u.0.iter_mut().zip(logits.0.iter().zip(&largest)) {
            *u = exp(logit - largest);
        }
        total = total.add::<A>(*u);
    }
    for u in u {
        for lane in 0..LANES {
            u.0[lane] /= total.0[lane];
        }
    }
}

/// `u_s (d_s - sum over r of u_r d_r)`, in place of the logits.
#[inline(always)]
fn softmax_gradient<A: Arithmetic>(u: &[Lanes], d_u: &[Lanes], logits: &mut [Lanes]) {
    let mut mean = Lanes::ZERO;
    for (u, d_u) in u.iter().zip(d_u) {
        mean = mean.add_product::<A>(*u, *d_u);
    }
    for (logits, (u, d_u)) in logits.iter_mut().zip(u.iter().zip(d_u)) {
        for lane in 0..LANES {
            logits.0[lane] = u.0[lane] * (d_u.0[lane] - mean.0[lane]);
        }
    }
}

/// `exp(x)` for `x <= 0` to 2 units in the last place, without a call, so that loops of it become
/// vectors: `2^n 2^f` with `|f| <= 1/2` and `2^f` by its series.
#[inline(always)]
fn exp(x: f32) -> f32 {
    /// Adding this rounds to a whole number, found in the low bits.
    const ROUND: f32 = 12_582_912.0;
    let power = x.max(-87.0) * std::f32::consts::LOG2_E;
    let rounded = power + ROUND;
    let f = (power - (rounded - ROUND)) * std::f32::consts::LN_2;
    let series = [
        1.0 / 720.0,
        1.0 / 120.0,
        1.0 / 24.0,
        1.0 / 6.0,
        0.5,
        1.0,
        1.0,
    ];
    let fraction = series.iter().fold(0.0, |sum, term| sum * f + term);
    f32::from_bits(fraction.to_bits().wrapping_add(rounded.to_bits() << 23))
}

#[cfg(test)]
mod tests {
    use super::super::lanes::Portable;
    use super::*;

    #[test]
    fn exp_is_the_exponential() {
        for step in 0..8700 {
            let x = -0.01 * step as f32;
            let exact = f64::from(x).exp();
            let error = (f64::from(exp(x)) / exact - 1.0).abs();
            // The argument's own rounding grows with it.
            assert!(error < 3e-7 + 1e-7 * f64::from(x.abs()), "{x}: {error}");
        }
    }

    /// The loss in 64 bits, written as in the paper, with a number added inside logarithms.
    fn exact(parameters: &[f64], logits: &[f64], value: usize, floor: f64) -> f64 {
        let n_states = logits.len();
        let total: f64 = logits.iter().map(|x| x.exp()).sum();
        let column = |state: usize| parameters.iter().skip(state).step_by(n_states);
        let q = |observed: usize| -> f64 {
            (0..n_states)
                .map(|state| {
                    let sum: f64 = column(state).map(|p| p.exp()).sum();
                    parameters[observed * n_states + state].exp() / sum * logits[state].exp()
                        / total
                })
                .sum()
        };
        (0..parameters.len() / n_states)
            .map(|observed| match observed == value {
                true => -(floor + q(observed)).ln(),
                false => -(floor + 1.0 - q(observed)).ln(),
            })
            .sum()
    }

    #[test]
    fn exact_logarithms_are_infinite_at_certainty_and_unseen_cells_add_nothing() {
        // All three states look like observation 0, to the last bit.
        let parameters = [200.0, 200.0, 200.0, 0.0, 0.0, 0.0];
        let sum = |floor: f32, value: u8| {
            let loss = CellLoss::new(&parameters, 3, 1).with_log_floor(floor);
            let (mut loss, mut lanes) = (loss, [Lanes::ZERO; 3]);
            let mut values = [UNOBSERVED; LANES];
            values[2] = value;
            loss.add::<Portable>(&mut lanes, &values);
            assert!(lanes.iter().all(|d| d.0[1] == 0.0), "{lanes:?}");
            loss.sum()
        };
        assert_eq!([sum(0.0, UNOBSERVED), sum(0.0, 0)], [0.0, 0.0]);
        assert_eq!(sum(0.0, 1), f64::INFINITY);
        // Twice the logarithm of 1e-10.
        assert!((sum(1e-10, 1) - 46.05).abs() < 0.01);
    }

    #[test]
    fn gradients_are_finite_differences() {
        // Of the divisors and floors, 5 and 0.25 show in every number.
        for (n_states, n_observations, divisor, floor) in [
            (3, 3, 1, 1e-10),
            (2, 4, 5, 0.0),
            (4, 2, 1, 0.25),
            (1, 3, 5, 0.25),
        ] {
            let share = 1.0 / divisor as f64;
            let wave = |index: usize| (index as f64 * 1.7).sin();
            let parameters: Vec<f64> = (0..n_states * n_observations).map(wave).collect();
            let logits: Vec<f64> = (0..n_states).map(|state| 2.0 * wave(state + 50)).collect();
            let value = n_observations - 1;
            let single = |values: &[f64]| values.iter().map(|&x| x as f32).collect::<Vec<_>>();
            let loss = CellLoss::new(&single(&parameters), n_states, divisor);
            let mut loss = loss.with_log_floor(floor as f32);
            let mut lanes: Vec<Lanes> = logits.iter().map(|&x| Lanes([x as f32; LANES])).collect();
            let mut values = [UNOBSERVED; LANES];
            values[5] = value as u8;
            loss.add::<Portable>(&mut lanes, &values);
            let close = |got: f32, expected: f64, what: &str| {
                let error = (f64::from(got) - expected).abs();
                assert!(error < 1e-5, "{what}: expected {expected}, got {got}");
            };
            close(
                loss.sum() as f32,
                exact(&parameters, &logits, value, floor),
                "loss",
            );
            let slope = |f: &dyn Fn(f64) -> f64| (f(1e-5) - f(-1e-5)) / 2e-5;
            for state in 0..n_states {
                let moved = |by: f64| {
                    let mut logits = logits.clone();
                    logits[state] += by;
                    share * exact(&parameters, &logits, value, floor)
                };
                close(lanes[state].0[5], slope(&moved), "logit");
                close(lanes[state].0[4], 0.0, "unseen");
            }
            let gradient = CellLoss::gradient(std::iter::once(&loss));
            for (index, got) in gradient.into_iter().enumerate() {
                let moved = |by: f64| {
                    let mut parameters = parameters.clone();
                    parameters[index] += by;
                    share * exact(&parameters, &logits, value, floor)
                };
                close(got, slope(&moved), "observation matrix");
            }
        }
    }
}
