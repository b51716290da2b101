//! The weights of paper eq. 2 for each tap (kernel position), and the draw of a state in proportion to weights.

use super::super::parameters::Ratio;

#[derive(Debug, Clone)]
pub(super) struct Kernel {
    pub(super) n_states: usize,
    pub(super) n_taps: usize,
    /// `w[m, n, t]` as `[tap][from][to]`. The centre tap includes the bias, because its neighbour is the cell itself,
    /// which always exists.
    pub(super) weights: Vec<f64>,
}

impl Kernel {
    pub(super) fn new(ratio: &Ratio) -> Self {
        let (kernel, bias) = (ratio.kernel(), ratio.bias());
        let (n_states, _, kernel_height, kernel_width) = kernel.dim();
        let n_taps = kernel_height * kernel_width;
        // A common factor cancels in eq. 3. Dividing by the largest weight keeps sums of weights from overflowing.
        let largest = kernel.iter().chain(bias).copied().fold(0.0, f64::max);
        let mut weights = Vec::with_capacity(n_taps * n_states * n_states);
        for tap in 0..n_taps {
            let (row, col) = (tap / kernel_width, tap % kernel_width);
            for from in 0..n_states {
                weights.extend((0..n_states).map(|to| {
                    let bias = if tap == n_taps / 2 { bias[to] } else { 0.0 };
                    (kernel[[to, from, row, col]] + bias) / largest
                }));
            }
        }
        Self {
            n_states,
            n_taps,
            weights,
        }
    }

    /// Returns the weight of each next state, given a tap and the state of the neighbour there.
    pub(super) fn weights(&self, tap: usize, from: usize) -> &[f64] {
        &self.weights[(tap * self.n_states + from) * self.n_states..][..self.n_states]
    }
}

/// Converts the high 53 bits to a number in `[0, 1)`.
pub(super) fn uniform(random: u64) -> f64 {
    (random >> 11) as f64 * 2f64.powi(-53)
}

/// Returns the state at which the cumulative weights exceed the fraction `uniform` of their sum, which need not be one.
pub(super) fn invert(weights: &[f64], uniform: f64) -> u8 {
    let target = uniform * weights.iter().sum::<f64>();
    let mut sum = 0.0;
    let reached = weights.iter().position(|weight| {
        sum += weight;
        target < sum
    });
    // Rounding can leave the target beyond the last sum. Then the last state with a positive weight is drawn.
    let last = || weights.iter().rposition(|&weight| weight > 0.0);
    let state = reached
        .or_else(last)
        .expect("invariant: the weights have a positive sum");
    state as u8
}
