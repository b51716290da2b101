//! A kernel as a mixture over its taps, from which [`super::bytes`] and [`super::parents`] make their tables.

use super::kernel::Kernel;

/// The kernel of all cells, or of cells in one own state, as a mixture over taps.
#[derive(Debug)]
pub(super) struct Mixture<'k> {
    kernel: &'k Kernel,
    /// The largest column sum of each tap: `most[t] = max_n sum_m w[m, n, t]`.
    most: Vec<f64>,
    /// `C`, the sum of `most`.
    total: f64,
    /// `f`: for each tap and neighbour state, the next state with the largest weight, as `[tap][from]`.
    likeliest: Vec<Vec<usize>>,
    /// For each tap, the number of byte values (of 256) that stand for it.
    counts: Vec<usize>,
    n_zones: usize,
}

impl<'k> Mixture<'k> {
    /// Returns one mixture per kernel. The mixtures of all zones share the same `f`.
    pub(super) fn of_kernels(
        kernels: &'k [Kernel],
        n_zones: usize,
        see_own_state: bool,
    ) -> Vec<Self> {
        let n_own = kernels.len() / n_zones;
        let of_zones = |own: usize| kernels.iter().skip(own).step_by(n_own);
        let likeliest: Vec<_> = (0..n_own)
            .map(|own| likeliest(&of_zones(own).collect::<Vec<_>>(), see_own_state))
            .collect();
        let mixtures = kernels.iter().enumerate();
        mixtures
            .map(|(index, kernel)| Self::new(kernel, likeliest[index % n_own].clone(), n_zones))
            .collect()
    }

    fn new(kernel: &'k Kernel, likeliest: Vec<Vec<usize>>, n_zones: usize) -> Self {
        let columns = kernel.weights.chunks(kernel.n_states);
        let column_sums: Vec<f64> = columns.map(|column| column.iter().sum()).collect();
        let largest = |sums: &[f64]| sums.iter().copied().fold(0.0, f64::max);
        let most: Vec<f64> = column_sums.chunks(kernel.n_states).map(largest).collect();
        let total = most.iter().sum();
        let count = |tap: usize| {
            let certain = likeliest[tap].iter().enumerate();
            let certain = certain.map(|(from, &to)| kernel.weights(tap, from)[to]);
            (256.0 * certain.fold(f64::INFINITY, f64::min) / total) as usize
        };
        let mut counts: Vec<usize> = (0..kernel.n_taps).map(count).collect();
        // If bounds differ between lanes, a bound is the first value after the tap's values. A bound must fit in a
        // byte, so it is at most 255.
        if n_zones > 1
            && counts.iter().sum::<usize>() > 255
            && let Some(most) = counts.iter_mut().max()
        {
            *most -= 1;
        }
        Self {
            counts,
            kernel,
            most,
            total,
            likeliest,
            n_zones,
        }
    }

    pub(super) fn n_zones(&self) -> usize {
        self.n_zones
    }

    pub(super) fn n_states(&self) -> usize {
        self.kernel.n_states
    }

    /// Returns the number of nonzero weights.
    pub(super) fn n_weights(&self) -> usize {
        let weights = self.kernel.weights.iter();
        weights.filter(|&&weight| weight > 0.0).count()
    }

    /// Returns `f` at a tap.
    pub(super) fn likeliest(&self, tap: usize) -> &[usize] {
        &self.likeliest[tap]
    }

    /// Returns, for each tap, the number of byte values (of 256) that stand for it.
    pub(super) fn counts(&self) -> &[usize] {
        &self.counts
    }

    /// Returns the probability of a tap.
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
        let likeliest = self.likeliest[tap].iter();
        likeliest.enumerate().map(of_parent).collect()
    }
}

/// Returns the common `f` of several kernels, as `[tap][from]`.
fn likeliest(kernels: &[&Kernel], see_own_state: bool) -> Vec<Vec<usize>> {
    let n_taps = kernels[0].n_taps;
    if !see_own_state {
        return vec![likeliest_under(kernels, 0..n_taps); n_taps];
    }
    let centre = n_taps / 2;
    let neighbours = (0..n_taps).filter(|&tap| tap != centre);
    let mut likeliest = vec![likeliest_under(kernels, neighbours); n_taps];
    likeliest[centre] = likeliest_under(kernels, std::iter::once(centre));
    likeliest
}

/// Returns, for each state, the next state with the largest sum of weights over some taps.
fn likeliest_under(kernels: &[&Kernel], taps: impl Iterator<Item = usize> + Clone) -> Vec<usize> {
    let n_states = kernels[0].n_states;
    let sum = |from, to| {
        let of_kernel = |kernel: &&Kernel| -> f64 {
            taps.clone().map(|tap| kernel.weights(tap, from)[to]).sum()
        };
        kernels.iter().map(of_kernel).sum()
    };
    let likeliest = |from| {
        let sums: Vec<f64> = (0..n_states).map(|to| sum(from, to)).collect();
        let better = |best, to| if sums[to] > sums[best] { to } else { best };
        (0..n_states).fold(0, better)
    };
    (0..n_states).map(likeliest).collect()
}
