//! The reward of each state, estimated from the rewards of paths.
//!
//! A path's reward is the sum of the rewards of its distinct cells (paper eq. 18). Its expectation is
//! `sum_s r[s] x[s]`, where `x[s]` is the sum of the posteriors of state s over the visited cells. `r` is estimated by
//! least squares with exponential forgetting, because early posteriors are poor. A learned filter has no other way to
//! find out which of its states is the fire.

use crate::checkpoint::check_numbers;
use anyhow::Result;
use emberwatch_belief::estimation::belief::Belief;
use serde::{Deserialize, Serialize};

/// Decay factor of the accumulated sums per path. It corresponds to a memory of 2,000 paths.
const KEPT: f64 = 0.9995;

/// Ridge term on the diagonal, in squared cells. It makes the system solvable even if a state was never visited.
const RIDGE: f64 = 1.0;

/// Returns the expected number of visited cells in each state, under the posterior after the path's frame.
pub fn met(posterior: &Belief, visited: &[usize]) -> Vec<f64> {
    let n_cells = posterior.shape().n_cells();
    let planes = posterior.as_slice().chunks_exact(n_cells);
    let cells = |plane: &[f32]| visited.iter().map(|&cell| f64::from(plane[cell])).sum();
    planes.map(cells).collect()
}

/// An estimate of the reward of each state, stored as the sums of the least-squares problem.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RewardEstimate {
    /// `sum x x'`, shape `[S, S]`.
    pub products: Vec<f64>,
    /// `sum x r`, shape `[S]`.
    pub rewards: Vec<f64>,
}

impl RewardEstimate {
    pub fn new(n_states: usize) -> Self {
        Self {
            products: vec![0.0; n_states * n_states],
            rewards: vec![0.0; n_states],
        }
    }

    /// Checks an estimate from a checkpoint: its shapes, and that its values are finite.
    pub fn check(&self, n_states: usize) -> Result<()> {
        check_numbers("reward.products", &self.products, n_states * n_states)?;
        check_numbers("reward.rewards", &self.rewards, n_states)
    }

    /// Adds a path: the expected number of visited cells in each state, and its reward.
    pub fn add(&mut self, met: &[f64], reward: f64) {
        let n_states = self.rewards.len();
        for (state, &cells) in met.iter().enumerate() {
            let row = &mut self.products[state * n_states..][..n_states];
            for (product, &others) in row.iter_mut().zip(met) {
                *product = KEPT * *product + cells * others;
            }
            self.rewards[state] = KEPT * self.rewards[state] + cells * reward;
        }
    }

    /// Returns the estimated reward of a cell in each state.
    pub fn of_states(&self) -> Vec<f64> {
        let n = self.rewards.len();
        let mut matrix = self.products.clone();
        let mut solution = self.rewards.clone();
        (0..n).for_each(|i| matrix[i * n + i] += RIDGE);
        // Gaussian elimination. The matrix is positive definite, so that pivoting is unnecessary.
        for pivot in 0..n {
            for row in pivot + 1..n {
                let factor = matrix[row * n + pivot] / matrix[pivot * n + pivot];
                for col in pivot..n {
                    matrix[row * n + col] -= factor * matrix[pivot * n + col];
                }
                solution[row] -= factor * solution[pivot];
            }
        }
        for row in (0..n).rev() {
            let known: f64 = (row + 1..n)
                .map(|col| matrix[row * n + col] * solution[col])
                .sum();
            solution[row] = (solution[row] - known) / matrix[row * n + row];
        }
        solution
    }

    /// Returns the state with the highest estimated reward. `None` before the first reward.
    pub fn target(&self) -> Option<usize> {
        let rewards = self.of_states();
        let best = (0..rewards.len()).max_by(|&a, &b| rewards[a].total_cmp(&rewards[b]))?;
        (self.rewards.iter().any(|&reward| reward != 0.0)).then_some(best)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rewards_of_states_are_found_from_rewards_of_paths() {
        let mut estimate = RewardEstimate::new(3);
        assert_eq!(estimate.target(), None);
        for path in 0..200 {
            let cells =
                |state: u64| (emberwatch_model::randomness::split_mix(path, state) % 20) as f64;
            let met = [cells(0), cells(1), cells(2)];
            estimate.add(&met, 2.0 * met[1] - 0.5 * met[2]);
        }
        let found = estimate.of_states();
        for (found, expected) in found.iter().zip([0.0, 2.0, -0.5]) {
            assert!((found - expected).abs() < 0.01, "{found} {expected}");
        }
        assert_eq!(estimate.target(), Some(1));
        let mut estimate = RewardEstimate::new(3);
        estimate.add(&[0.0, 2.0, 0.0], 6.0);
        // The ridge term, 1, is added to the sum of squares, 4. States that were never met keep reward 0.
        assert_eq!(estimate.of_states(), [0.0, 12.0 / 5.0, 0.0]);
    }
}
