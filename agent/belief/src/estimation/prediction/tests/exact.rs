//! The exact Bayes filter of a small grid: it enumerates the joint states of all cells.

use super::{formula, random};
use crate::estimation::belief::Belief;
use crate::estimation::prediction::Prediction;
use emberwatch_model::{Grid, Model, Shape};

/// The probability of each joint state of a small grid.
#[derive(Clone)]
struct Exact {
    shape: Shape,
    /// For each joint state and cell, the distribution of the cell's next state.
    next: Vec<Vec<[f64; 3]>>,
    joint: Vec<f64>,
}

/// Returns the state of a cell in a joint state. The index of a joint state has one ternary digit per cell, with cell 0
/// as the lowest digit.
fn state(joint: usize, cell: usize) -> usize {
    joint / 3_usize.pow(cell as u32) % 3
}

/// Returns the probability that a cell in the given state is observed as the given value.
fn likelihood(state: usize, value: usize) -> f64 {
    if state == value { 0.9 } else { 0.05 }
}

impl Exact {
    /// Creates the filter of a grid with cell 0 in state 1 and all other cells in state 0.
    fn new(shape: Shape, model: &Model) -> Self {
        let n = 3_usize.pow(shape.n_cells() as u32);
        let next = |joint: usize| {
            // If all states are certain, the formula is exact.
            let states = (0..shape.n_cells())
                .map(|cell| state(joint, cell) as u8)
                .collect();
            let states = Grid::from_shape_vec(shape.dim(), states).expect("a grid");
            let next = formula(model, &Belief::from_states(&states, 3).expect("states"));
            let cells = (0..shape.n_cells()).map(|index| shape.cell(index));
            cells
                .map(|cell| [0, 1, 2].map(|m| next[[m, cell.row, cell.col]]))
                .collect()
        };
        let mut joint = vec![0.0; n];
        joint[1] = 1.0;
        let next = (0..n).map(next).collect();
        Self { shape, next, joint }
    }

    fn predict(&mut self) {
        let mut joint = vec![0.0; self.joint.len()];
        for (next, p) in self.next.iter().zip(&self.joint).filter(|(_, p)| **p > 0.0) {
            let mut all = vec![*p];
            for cell in next.iter().rev() {
                all = all.iter().flat_map(|p| cell.map(|q| p * q)).collect();
            }
            joint.iter_mut().zip(all).for_each(|(to, p)| *to += p);
        }
        self.joint = joint;
    }

    fn correct(&mut self, seen: &[(usize, usize)]) {
        for (joint, p) in self.joint.iter_mut().enumerate() {
            for (cell, value) in seen {
                *p *= likelihood(state(joint, *cell), *value);
            }
        }
        let total: f64 = self.joint.iter().sum();
        self.joint.iter_mut().for_each(|p| *p /= total);
    }

    /// Returns the Kullback-Leibler divergence of a belief from the exact belief, summed over cells.
    fn divergence_of(&self, belief: &Belief) -> f64 {
        let mut sum = 0.0;
        for cell in 0..self.shape.n_cells() {
            let mut marginal = [0.0; 3];
            for (joint, p) in self.joint.iter().enumerate() {
                marginal[state(joint, cell)] += p;
            }
            for (p, q) in marginal.into_iter().zip(belief.states(cell)) {
                sum += if p > 0.0 {
                    p * (p / q.max(1e-12)).ln()
                } else {
                    0.0
                };
            }
        }
        sum
    }

    /// Draws the next joint state after `joint`.
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

/// Simulates worlds whose first cell starts in state 1. For predictions without and with cavities, returns the
/// Kullback-Leibler divergence of the beliefs from the exact beliefs, as the mean over steps and cells. Frames show each
/// cell with probability `1 / one_in`. If `one_in` is 0, frames show no cells.
pub fn divergences(model: &Model, shape: Shape, one_in: u64, n_worlds: u64) -> [f64; 2] {
    let mut states = Grid::zeros(shape.dim());
    states[[0, 0]] = 1;
    let start = Exact::new(shape, model);
    let mut sums = [0.0; 2];
    for world in 0..n_worlds {
        let (mut exact, mut truth) = (start.clone(), 1);
        let mut followed = [false, true].map(|cavities| {
            let belief = Belief::from_states(&states, 3).expect("states");
            let prediction = Prediction::known(model, &belief, cavities);
            (prediction.expect("fits"), belief)
        });
        let mut n_drawn = 0;
        let mut random = || {
            n_drawn += 1;
            random(world, n_drawn)
        };
        for _ in 0..12 {
            truth = exact.draw(truth, &mut random);
            exact.predict();
            for ((prediction, belief), sum) in followed.iter_mut().zip(&mut sums) {
                prediction.predict(belief);
                *sum += exact.divergence_of(belief);
            }
            let seen = observe(truth, shape, one_in, &mut random);
            exact.correct(&seen);
            for (prediction, belief) in &mut followed {
                let before = belief.as_slice().to_vec();
                correct(belief, &seen);
                prediction.correct(&before, belief.as_slice());
            }
        }
    }
    sums.map(|sum| sum / (12 * n_worlds as usize * shape.n_cells()) as f64)
}

/// Draws the observed cells and their observations.
fn observe(
    truth: usize,
    shape: Shape,
    one_in: u64,
    random: &mut impl FnMut() -> f64,
) -> Vec<(usize, usize)> {
    let mut seen = Vec::new();
    for cell in 0..shape.n_cells() {
        if one_in > 0 && random() * (one_in as f64) < 1.0 {
            let others = match random() {
                u if u < 0.05 => 1,
                u if u < 0.1 => 2,
                _ => 0,
            };
            seen.push((cell, (state(truth, cell) + others) % 3));
        }
    }
    seen
}

/// Corrects each observed cell's belief by Bayes' rule.
fn correct(belief: &mut Belief, seen: &[(usize, usize)]) {
    let n_cells = belief.shape().n_cells();
    let numbers = belief.as_mut_slice();
    for (cell, value) in seen {
        let likelihood = |state: usize| likelihood(state, *value) as f32;
        let joint = [0, 1, 2].map(|state| numbers[state * n_cells + cell] * likelihood(state));
        let total: f32 = joint.iter().sum();
        (0..3).for_each(|state| numbers[state * n_cells + cell] = joint[state] / total);
    }
}
