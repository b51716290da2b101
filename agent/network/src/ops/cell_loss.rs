//! The loss of paper eqs. 8 and 11.
//!
//! At a visited cell, the predictor is `u = softmax(logits)` and the distribution of the observation is `q = O u`. The
//! loss is the binary cross-entropy of all O channels: `-log q_y - sum over a != y of log(1 - q_a)`.

use super::cpu::{Frames, frames, total};
use crate::window::Window;

/// A constant that is added inside logarithms, as in the authors' code. It keeps the loss finite if a probability is
/// rounded to 0 or 1.
pub(crate) const LOG_FLOOR: f64 = 1e-10;

/// The mean loss over a window's targets, in nats per cell, and its gradients.
pub(crate) struct WindowLoss {
    pub(crate) loss: f64,
    pub(crate) d_logits: Frames,
    /// Gradient of `O [observations, states]`.
    pub(crate) d_observation: Vec<f32>,
}

/// Computes the loss from the logits of each frame, `[states, rows, cols]`.
pub(crate) fn window_loss(
    window: &Window,
    logits: &Frames,
    observation: &[f32],
    [n_states, rows, cols]: [usize; 3],
) -> WindowLoss {
    let (weight, area) = (1.0 / window.all_targets().len() as f32, rows * cols);
    let (d_logits, losses) = frames(
        window.len(),
        |_| n_states * area,
        || {
            (
                CellLoss::new(observation, n_states, weight),
                vec![0.0; n_states],
            )
        },
        #[inline(always)]
        |(loss, of_cell), frame, d_logits| {
            let logits = logits.frame(frame);
            for visit in window.targets(frame) {
                let cell = usize::from(visit.row) * cols + usize::from(visit.col);
                for (state, logit) in of_cell.iter_mut().enumerate() {
                    *logit = logits[state * area + cell];
                }
                loss.add(of_cell, visit.value);
                for (state, d) in of_cell.iter().enumerate() {
                    d_logits[state * area + cell] = *d;
                }
            }
        },
    );
    let losses: Vec<CellLoss<'_>> = losses.into_iter().map(|(loss, _)| loss).collect();
    let d_observation = total(losses.iter().map(|loss| loss.d_observation.clone()));
    WindowLoss {
        loss: losses.iter().map(|loss| loss.loss).sum(),
        d_logits,
        d_observation: d_observation.into_iter().map(|d| d as f32).collect(),
    }
}

struct CellLoss<'a> {
    /// `O [observations, states]`, whose columns sum to one.
    observation: &'a [f32],
    weight: f32,
    loss: f64,
    d_observation: Vec<f64>,
    u: Vec<f32>,
    q: Vec<f32>,
    d_u: Vec<f32>,
}

impl<'a> CellLoss<'a> {
    fn new(observation: &'a [f32], n_states: usize, weight: f32) -> Self {
        Self {
            observation,
            weight,
            loss: 0.0,
            d_observation: vec![0.0; observation.len()],
            u: vec![0.0; n_states],
            q: vec![0.0; observation.len() / n_states],
            d_u: vec![0.0; n_states],
        }
    }

    /// The loss is minus the logarithm of a product. The product underflows only if `q_y` does: all `q` sum to one, so
    /// at most one other factor `1 - q_a` is small, and this factor is zero or at least 6e-8.
    #[inline(always)]
    fn add(&mut self, logits: &mut [f32], value: u8) {
        let largest = logits.iter().copied().fold(f32::MIN, f32::max);
        for (u, logit) in self.u.iter_mut().zip(&*logits) {
            *u = (logit - largest).exp();
        }
        let inverse = 1.0 / self.u.iter().sum::<f32>();
        self.u.iter_mut().for_each(|u| *u *= inverse);
        let mut likelihood = 1.0;
        let rows = self.observation.chunks_exact(self.u.len());
        for (index, (q, row)) in self.q.iter_mut().zip(rows).enumerate() {
            *q = row.iter().zip(&self.u).map(|(o, u)| o * u).sum();
            likelihood *= term(*q, index == usize::from(value));
        }
        self.loss -= f64::from(self.weight) * f64::from(likelihood.ln());
        self.backward(logits, value);
    }

    #[inline(always)]
    fn backward(&mut self, d_logits: &mut [f32], value: u8) {
        let n_states = self.u.len();
        self.d_u.fill(0.0);
        for (index, q) in self.q.iter().enumerate() {
            let hit = index == usize::from(value);
            let d_q = if hit { -self.weight } else { self.weight } / term(*q, hit);
            for state in 0..n_states {
                let at = index * n_states + state;
                self.d_u[state] += self.observation[at] * d_q;
                self.d_observation[at] += f64::from(d_q * self.u[state]);
            }
        }
        let mean: f32 = self.u.iter().zip(&self.d_u).map(|(u, d)| u * d).sum();
        let pairs = self.u.iter().zip(&self.d_u);
        for (d, (u, d_u)) in d_logits.iter_mut().zip(pairs) {
            *d = u * (d_u - mean);
        }
    }
}

/// Rounding can make `q` larger than 1, so `1 - q` is limited to at least 0.
#[inline(always)]
fn term(q: f32, hit: bool) -> f32 {
    LOG_FLOOR as f32 + if hit { q } else { (1.0 - q).max(0.0) }
}
