//! The exact Bayes filter of a small grid: it enumerates the joint states of all cells.

use super::predict;
use crate::estimation::belief::Belief;
use crate::estimation::prediction::{Prediction, PredictionKind, Weights};
use emberwatch_model::randomness::split_mix;
use emberwatch_model::{Grid, Shape};

/// Probability that a cell is observed as its state, and as each of the two others.
const RIGHT: f64 = 0.9;
const WRONG: f64 = 0.05;

/// The probability of each joint state of a small grid.
#[derive(Clone)]
struct Exact {
    shape: Shape,
    /// For each joint state and cell, the distribution of the cell's next state.
    next: Vec<Vec<[f64; 3]>>,
    joint: Vec<f64>,
}

impl Exact {
    fn new(shape: Shape, weights: Weights<'_>, first: &[u8]) -> Self {
        let kernels = weights.kernels;
        let n = 3_usize.pow(shape.n_cells() as u32);
        let state = |joint: usize, cell: usize| joint / 3_usize.pow(cell as u32) % 3;
        let next = |joint: usize| {
            let cell = |index: usize| {
                let (cell, own) = (shape.cell(index), state(joint, index));
                let mut sums = [0, 1, 2].map(|m| weights.bias[m]);
                let kernel = &kernels[own % kernels.len()];
                for (a, c) in (0..9).map(|at| (at / 3, at % 3)) {
                    let (row, col) = (
                        (cell.row + a).wrapping_sub(1),
                        (cell.col + c).wrapping_sub(1),
                    );
                    if row < shape.height() && col < shape.width() {
                        let n = state(joint, row * shape.width() + col);
                        (0..3).for_each(|m| sums[m] += kernel[[m, n, a, c]]);
                    }
                }
                let total: f64 = sums.iter().sum();
                sums.map(|weight| weight / total)
            };
            (0..shape.n_cells()).map(cell).collect()
        };
        let mut joint = vec![0.0; n];
        let index = first
            .iter()
            .rev()
            .fold(0, |index, state| 3 * index + usize::from(*state));
        joint[index] = 1.0;
        Self {
            shape,
            next: (0..n).map(next).collect(),
            joint,
        }
    }

    fn predict(&mut self) {
        let mut joint = vec![0.0; self.joint.len()];
        for (next, p) in self.next.iter().zip(&self.joint).filter(|(_, p)| **p > 0.0) {
            let mut all = vec![*p];
            // Cell 0 is the last digit of a joint state's number.
            for cell in next.iter().rev() {
                all = all.iter().flat_map(|p| cell.map(|q| p * q)).collect();
            }
            joint.iter_mut().zip(all).for_each(|(to, p)| *to += p);
        }
        self.joint = joint;
    }

    fn correct(&mut self, seen: impl Iterator<Item = (usize, u8)>) {
        for (cell, value) in seen {
            let step = 3_usize.pow(cell as u32);
            for (joint, p) in self.joint.iter_mut().enumerate() {
                *p *= likelihood(joint / step % 3, value);
            }
        }
        let total: f64 = self.joint.iter().sum();
        self.joint.iter_mut().for_each(|p| *p /= total);
    }

    /// Sums the divergence of a belief over all cells.
    fn divergence_of(&self, belief: &Belief) -> f64 {
        let mut sum = 0.0;
        for cell in 0..self.shape.n_cells() {
            for (state, q) in belief.states(cell).into_iter().enumerate() {
                let p = self.marginal(cell, state);
                if p > 0.0 {
                    sum += p * (p / q.max(1e-12)).ln();
                }
            }
        }
        sum
    }

    fn marginal(&self, cell: usize, state: usize) -> f64 {
        let step = 3_usize.pow(cell as u32);
        let all = self.joint.iter().enumerate();
        all.filter(|(joint, _)| joint / step % 3 == state)
            .map(|(_, p)| p)
            .sum()
    }

    /// Draws the joint state after `joint`.
    fn draw(&self, joint: usize, random: &mut impl FnMut() -> f64) -> usize {
        let cells = self.next[joint].iter().rev();
        cells.fold(0, |to, cell| {
            let mut u = random();
            let state = cell.iter().position(|p| {
                u -= p;
                u < 0.0
            });
            3 * to + state.unwrap_or(2)
        })
    }
}

/// Runs worlds whose first cell starts in the state `burning`, and returns the mean over steps and cells of the
/// Kullback-Leibler divergence of the prediction's beliefs from the exact ones. Frames show each cell with probability
/// `1 / one_in`, and never for 0.
pub fn divergence(
    (weights, burning): (Weights<'_>, u8),
    shape: Shape,
    kind: PredictionKind,
    (one_in, n_worlds): (u64, u64),
) -> f64 {
    let mut first = vec![0; shape.n_cells()];
    first[0] = burning;
    let start = Exact::new(shape, weights, &first);
    let states = Grid::from_shape_vec(shape.dim(), first).expect("a grid");
    let (mut sum, mut count) = (0.0, 0.0);
    for world in 0..n_worlds {
        let mut exact = start.clone();
        let mut belief = Belief::from_states(&states, 3).expect("states");
        let mut prediction = Prediction::new(weights, kind, &belief);
        let mut truth = start.joint.iter().position(|p| *p > 0.0).expect("a state");
        let mut n_drawn = 0;
        let mut random = || {
            n_drawn += 1;
            (split_mix(world, n_drawn) >> 11) as f64 / (1_u64 << 53) as f64
        };
        for _ in 0..12 {
            truth = exact.draw(truth, &mut random);
            exact.predict();
            predict(&mut prediction, &mut belief);
            sum += exact.divergence_of(&belief);
            count += shape.n_cells() as f64;
            let seen = observe(truth, shape, one_in, &mut random);
            exact.correct(seen.iter().copied());
            let before = belief.as_slice().to_vec();
            correct(&mut belief, &seen);
            prediction.correct(&before, belief.as_slice());
        }
    }
    sum / count
}

/// Draws the observed cells and their observations.
fn observe(
    truth: usize,
    shape: Shape,
    one_in: u64,
    random: &mut impl FnMut() -> f64,
) -> Vec<(usize, u8)> {
    let mut seen = Vec::new();
    for cell in 0..shape.n_cells() {
        if one_in > 0 && random() * (one_in as f64) < 1.0 {
            let state = truth / 3_usize.pow(cell as u32) % 3;
            let u = random();
            let other = (state + if u < WRONG { 1 } else { 2 }) % 3;
            seen.push((
                cell,
                if u < 2.0 * WRONG {
                    other as u8
                } else {
                    state as u8
                },
            ));
        }
    }
    seen
}

/// Corrects each observed cell's belief by Bayes' rule.
fn correct(belief: &mut Belief, seen: &[(usize, u8)]) {
    let n_cells = belief.shape().n_cells();
    let numbers = belief.as_mut_slice();
    for (cell, value) in seen {
        let likelihood = |state: usize| likelihood(state, *value) as f32;
        let total: f32 = (0..3)
            .map(|state| numbers[state * n_cells + cell] * likelihood(state))
            .sum();
        (0..3).for_each(|state| numbers[state * n_cells + cell] *= likelihood(state) / total);
    }
}

fn likelihood(state: usize, value: u8) -> f64 {
    if state == usize::from(value) {
        RIGHT
    } else {
        WRONG
    }
}
