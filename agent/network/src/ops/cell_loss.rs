//! The loss of paper eqs. 8 and 11, cell by cell.
//!
//! At a visited cell the predictor is `u = softmax(logits)`, the predicted observation `q = O u`, and the
//! loss the binary cross-entropy of all O channels: `-log q_y - sum over a != y of log(1 - q_a)`.

use super::cpu::{frames, numbers, slice, sums_over_frames, tensor, total};
use crate::window::{Visit, Window};
use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor};

/// Added inside logarithms, as by the authors: the loss stays finite where a probability is rounded to 0
/// or 1.
pub(crate) const LOG_FLOOR: f64 = 1e-10;

/// The mean over a window's targets. Arguments: logits `[frames, states, rows, cols]`; `O [observations,
/// states]`, whose columns sum to one. The result is one number.
pub(crate) struct CellLoss {
    pub(crate) window: Window,
}

/// One call.
struct Call<'a> {
    window: &'a Window,
    logits: &'a [f32],
    observation: &'a [f32],
    n_states: usize,
    area: usize,
    cols: usize,
}

/// Room for one cell.
struct Cell {
    u: Vec<f32>,
    q: Vec<f32>,
    d_u: Vec<f32>,
    d_logits: Vec<f32>,
}

impl Cell {
    fn new(n_states: usize, n_observations: usize) -> Self {
        Self {
            u: vec![0.0; n_states],
            q: vec![0.0; n_observations],
            d_u: vec![0.0; n_states],
            d_logits: vec![0.0; n_states],
        }
    }

    /// Fills `u` and `q`; returns the product of the probabilities whose logarithms are the loss.
    ///
    /// At most one factor other than `q_y` is near zero, as the `q` sum to one, and 6e-8 or more unless it is
    /// zero, so the product underflows only where `q_y` all but does.
    #[inline(always)]
    fn forward(
        &mut self,
        logits: impl Iterator<Item = f32> + Clone,
        observation: &[f32],
        value: u8,
    ) -> f32 {
        let largest = logits.clone().fold(f32::MIN, f32::max);
        for (u, logit) in self.u.iter_mut().zip(logits) {
            *u = (logit - largest).exp();
        }
        let inverse = 1.0 / self.u.iter().sum::<f32>();
        self.u.iter_mut().for_each(|u| *u *= inverse);
        let mut likelihood = 1.0;
        let rows = observation.chunks_exact(self.u.len());
        for (index, (q, row)) in self.q.iter_mut().zip(rows).enumerate() {
            *q = row.iter().zip(&self.u).map(|(o, u)| o * u).sum();
            likelihood *= term(*q, index == usize::from(value));
        }
        likelihood
    }

    /// After [`Self::forward`]: leaves the gradients of the logits, and adds that of `O`.
    #[inline(always)]
    fn backward(&mut self, observation: &[f32], value: u8, weight: f32, d_observation: &mut [f64]) {
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
        let pairs = self.u.iter().zip(&self.d_u);
        for (d, (u, d_u)) in self.d_logits.iter_mut().zip(pairs) {
            *d = u * (d_u - mean);
        }
    }
}

/// The probability of what an observation's channel showed. Rounding may take `q` above one.
#[inline(always)]
fn term(q: f32, hit: bool) -> f32 {
    LOG_FLOOR as f32 + if hit { q } else { (1.0 - q).max(0.0) }
}

impl<'a> Call<'a> {
    fn new(op: &'a CellLoss, dims: &[usize], logits: &'a [f32], observation: &'a [f32]) -> Self {
        Self {
            window: &op.window,
            logits,
            observation,
            n_states: dims[1],
            area: dims[2] * dims[3],
            cols: dims[3],
        }
    }

    fn cell(&self) -> Cell {
        Cell::new(self.n_states, self.observation.len() / self.n_states)
    }

    fn place(&self, visit: &Visit) -> usize {
        usize::from(visit.row) * self.cols + usize::from(visit.col)
    }

    /// The logits of a frame's cell.
    #[inline(always)]
    fn at(&self, frame: usize, visit: &Visit) -> impl Iterator<Item = f32> + Clone {
        let first = frame * self.n_states * self.area + self.place(visit);
        let logits = self.logits[first..].iter().step_by(self.area);
        logits.take(self.n_states).copied()
    }

    fn loss(&self) -> f64 {
        let new = || (self.cell(), 0.0);
        let sums = sums_over_frames(
            self.window.len(),
            new,
            #[inline(always)]
            |(cell, sum), frame| {
                for visit in self.window.targets(frame) {
                    let logits = self.at(frame, visit);
                    let likelihood = cell.forward(logits, self.observation, visit.value);
                    *sum -= f64::from(likelihood.ln());
                }
            },
        );
        let sum: f64 = sums.iter().map(|(_, sum)| sum).sum();
        sum / self.window.all_targets().len() as f64
    }

    /// Gradients of the logits and of `O`.
    fn gradients(&self, d_loss: f32) -> [Vec<f32>; 2] {
        let weight = d_loss / self.window.all_targets().len() as f32;
        let per_frame = self.n_states * self.area;
        let mut d_logits = vec![0.0; self.logits.len()];
        let sums = frames(
            &mut d_logits,
            self.window.len(),
            |frame| frame * per_frame,
            || (self.cell(), vec![0.0; self.observation.len()]),
            #[inline(always)]
            |(cell, sums), frame, d_logits| {
                for visit in self.window.targets(frame) {
                    let logits = self.at(frame, visit);
                    cell.forward(logits, self.observation, visit.value);
                    cell.backward(self.observation, visit.value, weight, sums);
                    let to = d_logits[self.place(visit)..].iter_mut().step_by(self.area);
                    to.zip(&cell.d_logits).for_each(|(to, d)| *to = *d);
                }
            },
        );
        let d_observation = total(sums.into_iter().map(|(_, sums)| sums));
        [d_logits, d_observation.iter().map(|&d| d as f32).collect()]
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
        let observation = slice(observation, observation_layout)?;
        let loss = Call::new(self, logits_layout.dims(), logits, observation).loss();
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
        let call = Call::new(self, logits.dims(), &arguments[0], &arguments[1]);
        let [d_logits, d_observation] = call.gradients(d_loss.to_scalar()?);
        let d_observation = tensor(d_observation, observation.shape())?;
        Ok((Some(tensor(d_logits, logits.shape())?), Some(d_observation)))
    }
}
