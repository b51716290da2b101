//! A kernel as a mixture over its taps, from which [`super::bytes`] and [`super::parents`] make their tables.

use super::kernel::Kernel;

#[derive(Debug)]
pub(super) struct Mixture<'k> {
    kernel: &'k Kernel,
    /// The largest column sum of each tap: `most[t] = max_n sum_m w[m, n, t]`.
    most: Vec<f64>,
    /// `C`, the sum of `most`.
    total: f64,
    /// `f`: for each neighbour state, the next state with the largest weight.
    likeliest: Vec<usize>,
    /// For each tap, the number of byte values (of 256) that stand for it.
    counts: Vec<usize>,
}

impl<'k> Mixture<'k> {
    pub(super) fn new(kernel: &'k Kernel) -> Self {
        let columns = kernel.weights.chunks(kernel.n_states);
        let column_sums: Vec<f64> = columns.map(|column| column.iter().sum()).collect();
        let largest = |sums: &[f64]| sums.iter().copied().fold(0.0, f64::max);
        let most: Vec<f64> = column_sums.chunks(kernel.n_states).map(largest).collect();
        let total = most.iter().sum();
        let likeliest = likeliest(kernel);
        let count = |tap: usize| {
            let certain = likeliest.iter().enumerate();
            let certain = certain.map(|(from, &to)| kernel.weights(tap, from)[to]);
            (256.0 * certain.fold(f64::INFINITY, f64::min) / total) as usize
        };
        Self {
            counts: (0..kernel.n_taps).map(count).collect(),
            kernel,
            most,
            total,
            likeliest,
        }
    }

    pub(super) fn n_states(&self) -> usize {
        self.kernel.n_states
    }

    pub(super) fn n_weights(&self) -> usize {
        let weights = self.kernel.weights.iter();
        weights.filter(|&&weight| weight > 0.0).count()
    }

    pub(super) fn likeliest(&self) -> &[usize] {
        &self.likeliest
    }

    pub(super) fn counts(&self) -> &[usize] {
        &self.counts
    }

    pub(super) fn share(&self, tap: usize) -> f64 {
        self.most[tap] / self.total
    }

    /// Returns the end of each outcome's part of a tap's interval, as `[parent state][outcome]`. The part of the most
    /// likely outcome is shortened by `taken`, the probability with which bytes have already drawn this outcome.
    pub(super) fn ends(&self, tap: usize, taken: f64) -> Vec<Vec<f64>> {
        let of_parent = |(from, &likeliest): (usize, &usize)| {
            let mut end = 0.0;
            let weights = self.kernel.weights(tap, from).iter().enumerate();
            let ends = weights.map(|(to, weight)| {
                let taken = if to == likeliest { taken } else { 0.0 };
                end += f64::max(weight / self.total - taken, 0.0);
                end
            });
            ends.collect()
        };
        let likeliest = self.likeliest.iter();
        likeliest.enumerate().map(of_parent).collect()
    }
}

fn likeliest(kernel: &Kernel) -> Vec<usize> {
    let likeliest = |from| {
        let sum = |to: usize| {
            (0..kernel.n_taps)
                .map(|tap| kernel.weights(tap, from)[to])
                .sum()
        };
        let sums: Vec<f64> = (0..kernel.n_states).map(sum).collect();
        let better = |best, to| if sums[to] > sums[best] { to } else { best };
        (0..kernel.n_states).fold(0, better)
    };
    (0..kernel.n_states).map(likeliest).collect()
}
