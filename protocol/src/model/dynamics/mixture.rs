//! A kernel as a mixture over its taps: what [`super::bytes`] and [`super::parents`] make their tables of.

use super::kernel::Kernel;

/// The kernel of all cells, or of those in one state themselves, as a mixture over taps.
#[derive(Debug)]
pub(super) struct Mixture<'k> {
    kernel: &'k Kernel,
    /// The largest column sum of each tap: `most[t] = max_n sum_m w[m, n, t]`.
    most: Vec<f64>,
    /// `C`, the sum of `most`.
    total: f64,
    /// `f`: the state that each state mostly leads to under each tap, `[tap][from]`.
    likeliest: Vec<Vec<usize>>,
    /// How many of 256 byte values stand for each tap.
    counts: Vec<usize>,
}

impl<'k> Mixture<'k> {
    /// One mixture for each kernel.
    pub(super) fn of_kernels(kernels: &'k [Kernel], see_own_state: bool) -> Vec<Self> {
        let mixtures = kernels
            .iter()
            .map(|kernel| Self::new(kernel, see_own_state));
        mixtures.collect()
    }

    fn new(kernel: &'k Kernel, sees_own_state: bool) -> Self {
        let columns = kernel.weights.chunks(kernel.n_states);
        let column_sums: Vec<f64> = columns.map(|column| column.iter().sum()).collect();
        let largest = |sums: &[f64]| sums.iter().copied().fold(0.0, f64::max);
        let most: Vec<f64> = column_sums.chunks(kernel.n_states).map(largest).collect();
        let likeliest = if sees_own_state {
            let centre = kernel.n_taps / 2;
            let neighbours = (0..kernel.n_taps).filter(|&tap| tap != centre);
            let mut likeliest = vec![likeliest_under(kernel, neighbours); kernel.n_taps];
            likeliest[centre] = likeliest_under(kernel, std::iter::once(centre));
            likeliest
        } else {
            vec![likeliest_under(kernel, 0..kernel.n_taps); kernel.n_taps]
        };
        let total = most.iter().sum();
        let count = |tap: usize| {
            let certain = likeliest[tap].iter().enumerate();
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

    /// How many weights are not zero.
    pub(super) fn n_weights(&self) -> usize {
        let weights = self.kernel.weights.iter();
        weights.filter(|&&weight| weight > 0.0).count()
    }

    /// `f` under a tap.
    pub(super) fn likeliest(&self, tap: usize) -> &[usize] {
        &self.likeliest[tap]
    }

    /// How many of 256 byte values stand for each tap.
    pub(super) fn counts(&self) -> &[usize] {
        &self.counts
    }

    /// The probability of a tap.
    pub(super) fn share(&self, tap: usize) -> f64 {
        self.most[tap] / self.total
    }

    /// For each state of the parent under a tap, where each outcome's part of the tap's interval ends;
    /// `taken` has gone from the likeliest outcome's.
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
        let likeliest = self.likeliest[tap].iter();
        likeliest.enumerate().map(of_parent).collect()
    }
}

/// The state that each state mostly leads to under some taps.
fn likeliest_under(kernel: &Kernel, taps: impl Iterator<Item = usize> + Clone) -> Vec<usize> {
    let sum = |from, to| taps.clone().map(|tap| kernel.weights(tap, from)[to]).sum();
    let likeliest = |from| {
        let sums: Vec<f64> = (0..kernel.n_states).map(|to| sum(from, to)).collect();
        let better = |best, to| if sums[to] > sums[best] { to } else { best };
        (0..kernel.n_states).fold(0, better)
    };
    (0..kernel.n_states).map(likeliest).collect()
}
