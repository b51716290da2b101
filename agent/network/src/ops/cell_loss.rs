//! The loss of paper eqs. 8 and 11, cell by cell.
//!
//! At a visited cell the predictor is `u = softmax(logits)`, the predicted observation `q = O u`, and the
//! loss the binary cross-entropy of all O channels: `-log q_y - sum over a != y of log(1 - q_a)`.

use super::cpu::{numbers, slice, tensor, total};
use crate::window::Visit;
use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor};
use rayon::prelude::*;
use std::sync::Arc;

/// Added inside logarithms, as by the authors: the loss stays finite where a probability is rounded to 0
/// or 1.
pub(crate) const LOG_FLOOR: f64 = 1e-10;

/// Cells that are worked on at once.
const CHUNK: usize = 4096;

/// The mean over cells. Arguments: logits `[cells, states]`; `O [observations, states]`, whose columns sum
/// to one. The result is one number.
pub(crate) struct CellLoss {
    /// What each cell showed.
    pub(crate) values: Arc<[u8]>,
}

/// Room for one cell.
struct Cell {
    u: Vec<f32>,
    q: Vec<f32>,
    d_u: Vec<f32>,
}

impl Cell {
    fn new(n_states: usize, n_observations: usize) -> Self {
        Self {
            u: vec![0.0; n_states],
            q: vec![0.0; n_observations],
            d_u: vec![0.0; n_states],
        }
    }

    /// Fills `u` and `q`; returns the product of the probabilities whose logarithms are the loss.
    ///
    /// At most one factor other than `q_y` is near zero, as the `q` sum to one, and 6e-8 or more unless it is
    /// zero, so the product underflows only where `q_y` all but does.
    #[inline(always)]
    fn forward(&mut self, logits: &[f32], observation: &[f32], value: u8) -> f32 {
        let largest = logits.iter().fold(f32::MIN, |a, b| a.max(*b));
        for (u, logit) in self.u.iter_mut().zip(logits) {
            *u = (logit - largest).exp();
        }
        let inverse = 1.0 / self.u.iter().sum::<f32>();
        self.u.iter_mut().for_each(|u| *u *= inverse);
        let mut likelihood = 1.0;
        let rows = observation.chunks_exact(logits.len());
        for (index, (q, row)) in self.q.iter_mut().zip(rows).enumerate() {
            *q = row.iter().zip(&self.u).map(|(o, u)| o * u).sum();
            likelihood *= term(*q, index == usize::from(value));
        }
        likelihood
    }

    /// After [`Self::forward`]: gradients of the logits, and adds that of `O`.
    #[inline(always)]
    fn backward(
        &mut self,
        observation: &[f32],
        value: u8,
        weight: f32,
        d_logits: &mut [f32],
        d_observation: &mut [f64],
    ) {
        let n_states = self.u.len();
        self.d_u.fill(0.0);
        for (index, q) in self.q.iter().enumerate() {
            let hit = index == usize::from(value);
            let d_q = if hit { -weight } else { weight } / term(*q, hit);
            for state in 0..n_states {
                let at = index * n_states + state;
                self.d_u[state] += observation[at] * d_q;
                d_observation[at] += f64::from(d_q * self.u[state]);
            }
        }
        let mean: f32 = self.u.iter().zip(&self.d_u).map(|(u, d)| u * d).sum();
        for (d, (u, d_u)) in d_logits.iter_mut().zip(self.u.iter().zip(&self.d_u)) {
            *d = u * (d_u - mean);
        }
    }
}

/// The probability of what an observation's channel showed. Rounding may take `q` above one.
#[inline(always)]
fn term(q: f32, hit: bool) -> f32 {
    LOG_FLOOR as f32 + if hit { q } else { (1.0 - q).max(0.0) }
}

impl CellLoss {
    fn forward(&self, logits: &[f32], observation: &[f32]) -> f64 {
        let n_states = logits.len() / self.values.len();
        let chunks = logits.par_chunks(CHUNK * n_states);
        let losses = chunks.zip(self.values.par_chunks(CHUNK));
        let loss = |(logits, values): (&[f32], &[u8])| -> f64 {
            let mut cell = Cell::new(n_states, observation.len() / n_states);
            let cells = logits.chunks_exact(n_states).zip(values);
            let likelihoods =
                cells.map(|(logits, value)| cell.forward(logits, observation, *value));
            likelihoods
                .map(|likelihood| -f64::from(likelihood.ln()))
                .sum()
        };
        let losses: Vec<f64> = losses.map(loss).collect();
        losses.iter().sum::<f64>() / self.values.len() as f64
    }

    fn backward(&self, logits: &[f32], observation: &[f32], d_loss: f32) -> [Vec<f32>; 2] {
        let n_states = logits.len() / self.values.len();
        let weight = d_loss / self.values.len() as f32;
        let mut d_logits = vec![0.0; logits.len()];
        let chunks = d_logits.par_chunks_mut(CHUNK * n_states);
        let chunks = chunks.zip(logits.par_chunks(CHUNK * n_states));
        let chunks = chunks.zip(self.values.par_chunks(CHUNK));
        let sums = chunks.map(|((d_logits, logits), values)| {
            let mut cell = Cell::new(n_states, observation.len() / n_states);
            let mut sums = vec![0.0; observation.len()];
            let logits = logits.chunks_exact(n_states).zip(values);
            for (d_logits, (logits, value)) in d_logits.chunks_exact_mut(n_states).zip(logits) {
                cell.forward(logits, observation, *value);
                cell.backward(observation, *value, weight, d_logits, &mut sums);
            }
            sums
        });
        let sums: Vec<Vec<f64>> = sums.collect();
        let d_observation = total(sums).iter().map(|&d| d as f32).collect();
        [d_logits, d_observation]
    }

    /// What some visited cells showed.
    pub(crate) fn of(targets: &[Visit]) -> Self {
        Self {
            values: targets.iter().map(|visit| visit.value).collect(),
        }
    }
}

impl CustomOp2 for CellLoss {
    fn name(&self) -> &'static str {
        "cell-loss"
    }

    fn cpu_fwd(
        &self,
        logits: &CpuStorage,
        logits_layout: &Layout,
        observation: &CpuStorage,
        observation_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let logits = slice(logits, logits_layout)?;
        let loss = self.forward(logits, slice(observation, observation_layout)?);
        Ok((CpuStorage::F32(vec![loss as f32]), ().into()))
    }

    fn bwd(
        &self,
        logits: &Tensor,
        observation: &Tensor,
        _loss: &Tensor,
        d_loss: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let arguments = [numbers(logits)?, numbers(observation)?];
        let d_loss = d_loss.to_scalar::<f32>()?;
        let [d_logits, d_observation] = self.backward(&arguments[0], &arguments[1], d_loss);
        let d_observation = tensor(d_observation, observation.shape())?;
        Ok((Some(tensor(d_logits, logits.shape())?), Some(d_observation)))
    }
}
