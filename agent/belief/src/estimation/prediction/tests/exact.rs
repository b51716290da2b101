//! The exact Bayes filter of a small grid: it enumerates the joint states of all cells.

use super::{formula, random};
use crate::Belief;
use crate::estimation::{BayesFilter, Estimator};
use emberwatch_model::dynamics::Dynamics;
use emberwatch_model::{Frame, Grid, Model, Shape};

/// Number of steps of each world.
const N_STEPS: u64 = 12;

#[derive(Clone)]
struct Exact {
    n_cells: usize,
    /// For each joint state and cell, the distribution of the cell's next state.
    next: Vec<Vec<[f64; 3]>>,
    /// The probability of each joint state. Its index has one ternary digit per cell, with cell 0 as the lowest digit.
    joint: Vec<f64>,
}

fn state(joint: usize, cell: usize) -> usize {
    joint / 3_usize.pow(cell as u32) % 3
}

impl Exact {
    /// Creates the filter of a grid with cell 0 in state 1 and all other cells in state 0.
    fn new(shape: Shape, model: &Model) -> Self {
        let n_cells = shape.n_cells();
        let next = |joint: usize| {
            // If all states are certain, the formula is exact.
            let states = (0..n_cells).map(|cell| state(joint, cell) as u8).collect();
            let states = Grid::from_shape_vec(shape.dim(), states).expect("a grid");
            let next = formula(model, &Belief::from_states(&states, 3).expect("states"));
            let cells = (0..n_cells).map(|index| shape.cell(index));
            let of = |m, cell: emberwatch_model::Cell| next[[m, cell.row, cell.col]];
            cells.map(|cell| [0, 1, 2].map(|m| of(m, cell))).collect()
        };
        let next: Vec<_> = (0..3_usize.pow(n_cells as u32)).map(next).collect();
        let mut joint = vec![0.0; next.len()];
        joint[1] = 1.0;
        Self {
            n_cells,
            next,
            joint,
        }
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

    fn correct(&mut self, model: &Model, frame: &Frame) {
        for (joint, p) in self.joint.iter_mut().enumerate() {
            for (cell, value) in frame.observed() {
                *p *= model.likelihood()[[state(joint, cell), usize::from(value)]];
            }
        }
        let total: f64 = self.joint.iter().sum();
        self.joint.iter_mut().for_each(|p| *p /= total);
    }

    /// Returns the Kullback-Leibler divergence of a belief from the exact belief, summed over cells.
    fn divergence_of(&self, belief: &Belief) -> f64 {
        let mut sum = 0.0;
        for cell in 0..self.n_cells {
            let mut marginal = [0.0; 3];
            for (joint, p) in self.joint.iter().enumerate() {
                marginal[state(joint, cell)] += p;
            }
            let pairs = marginal.into_iter().zip(belief.states(cell));
            let terms = pairs.map(|(p, q)| p * (p.max(1e-300) / q.max(1e-12)).ln());
            sum += terms.sum::<f64>();
        }
        sum
    }
}

/// Simulates worlds whose first cell starts in state 1. For filters without and with cavities, returns the
/// Kullback-Leibler divergence of the beliefs from the exact beliefs, as the mean over steps and cells. Frames show
/// each cell with probability `1 / one_in`. If `one_in` is 0, frames show no cells.
pub fn divergences(model: &Model, shape: Shape, one_in: u64, n_worlds: u64) -> [f64; 2] {
    let mut first = Grid::zeros(shape.dim());
    first[[0, 0]] = 1;
    let start = Exact::new(shape, model);
    let mut dynamics = Dynamics::new(model, shape).expect("fits");
    let mut sums = [0.0; 2];
    for world in 0..n_worlds {
        let (mut exact, mut states) = (start.clone(), first.clone());
        let mut filters = [false, true].map(|cavities| {
            let belief = Belief::from_states(&states, 3).expect("states");
            BayesFilter::known(model, belief, cavities).expect("fits")
        });
        let mut numbers = (0..).map(|at| random(world, at));
        for step in 0..N_STEPS {
            dynamics.step(world, step, &mut states);
            exact.predict();
            let mut frame = Frame::empty(shape);
            for (cell, &state) in states.iter().enumerate() {
                let [shown, other] = [(); 2].map(|()| numbers.next().expect("endless"));
                if shown * (one_in as f64) < 1.0 && one_in > 0 {
                    // The model shows each of the two other states with probability .05.
                    let off = usize::from(other < 0.1) + usize::from(other < 0.05);
                    frame.observe(cell, (state + off as u8) % 3);
                }
            }
            for (filter, sum) in filters.iter_mut().zip(&mut sums) {
                filter.predict();
                *sum += exact.divergence_of(filter.belief());
                filter.correct(&frame).expect("possible");
            }
            exact.correct(model, &frame);
        }
    }
    sums.map(|sum| sum / (N_STEPS * n_worlds * shape.n_cells() as u64) as f64)
}
