//! Observation noise: draws a sensor's reading of each observed cell (paper eq. 1).
//!
//! A reading is a pure function of (seed, step, cell), so two agents that observe the same cell in the same step get
//! the same reading. One ChaCha8 draw gives a key for the step, and SplitMix64 with this key generates each cell's random
//! number. So the cost is constant per observed cell, and other cells cost nothing.

use emberwatch_model::randomness::{Purpose, split_mix, stream};
use emberwatch_model::{Frame, Grid, Model};
use rand_chacha::rand_core::Rng;

/// The observation probabilities `P(y | x)` as thresholds on a 32-bit random number.
#[derive(Debug, Clone)]
pub struct Sensor {
    /// `thresholds[x * n_observations + y]` is the upper end of the interval of 32-bit numbers that give observation `y`
    /// in state `x`.
    thresholds: Vec<u64>,
    n_observations: usize,
}

impl Sensor {
    pub fn new(model: &Model) -> Self {
        let n_observations = model.n_observations();
        let cumulative = |row: &[f64]| {
            let mut sum = 0.0;
            let mut thresholds: Vec<u64> = row
                .iter()
                .map(|p| {
                    sum += p;
                    (sum * 2f64.powi(32)).round() as u64
                })
                .collect();
            // The last threshold is 2^32, so that every number maps to an observation despite rounding.
            let last = row.iter().rposition(|p| *p > 0.0).unwrap_or(row.len() - 1);
            thresholds[last..].fill(1 << 32);
            thresholds
        };
        let likelihood = model.likelihood().as_standard_layout();
        let rows = likelihood.as_slice().expect("invariant: row-major");
        let rows = rows.chunks_exact(n_observations);
        Self {
            thresholds: rows.flat_map(cumulative).collect(),
            n_observations,
        }
    }

    pub fn key(seed: u64, absolute_step: u64) -> u64 {
        stream(seed, Purpose::Sensor, absolute_step).next_u64()
    }

    /// Draws the readings of `cells` and writes them to the frame. `key` is the step's [`Self::key`].
    pub fn observe(
        &self,
        key: u64,
        states: &Grid<u8>,
        cells: impl IntoIterator<Item = usize>,
        frame: &mut Frame,
    ) {
        let states = states.as_slice().expect("invariant: states are row-major");
        for cell in cells {
            let number = split_mix(key, cell as u64) >> 32;
            let first = usize::from(states[cell]) * self.n_observations;
            let of_state = &self.thresholds[first..][..self.n_observations];
            // Compares with all thresholds, because a loop that stops early would cause a branch misprediction at every
            // latent cell.
            let passed = of_state.iter().filter(|threshold| number >= **threshold);
            frame.observe(cell, passed.count() as u8);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberwatch_model::Shape;

    #[test]
    fn readings_follow_the_matrix_whatever_else_is_observed() {
        let sensor = Sensor::new(&Model::wildfire());
        let shape = Shape::new(100, 100).expect("shape");
        let matrix = [
            [0.98_f64, 0.01, 0.01],
            [0.80, 0.15, 0.05],
            [0.01, 0.01, 0.98],
        ];
        for (state, expected) in matrix.iter().enumerate() {
            let states = Grid::from_elem(shape.dim(), state as u8);
            let look = |step: u64, cells: &[usize]| {
                let mut frame = Frame::empty(shape);
                let cells = cells.iter().copied();
                sensor.observe(Sensor::key(7, step), &states, cells, &mut frame);
                frame
            };
            let all: Vec<usize> = (0..shape.n_cells()).collect();
            let mut counts = [0.0_f64; 3];
            for step in 0..20 {
                let frame = look(step, &all);
                let values = frame.as_bytes();
                values.iter().for_each(|y| counts[usize::from(*y)] += 1.0);
                for (cell, value) in look(step, &[3, 17, 6000]).observed() {
                    assert_eq!(values[cell], value);
                }
            }
            let n = 20.0 * 10_000.0;
            for (count, &p) in counts.iter().zip(expected) {
                // 200,000 independent draws. By chance, each of the 9 counts deviates by more than 4.5 standard errors
                // in 1 of 150,000 runs.
                let bound = 4.5 * (p * (1.0 - p) / n).sqrt();
                assert!((count / n - p).abs() < bound, "state {state}: {counts:?}");
            }
        }
    }
}
