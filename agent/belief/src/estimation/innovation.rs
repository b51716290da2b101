//! Bayes' rule at one cell, and what it does to the probability of one state.

use ndarray::Array2;

/// A variance that is divided by is at least this.
const LEAST_VARIANCE: f64 = 1e-9;

/// What an observation does to a cell's paying state.
#[derive(Debug, Clone, Copy)]
pub struct Innovation {
    /// The probability of the observation, more than 0.
    pub evidence: f64,
    /// Posterior minus prior probability of the state.
    pub value: f64,
    /// What seeing the cell takes off the variance, on average over observations.
    pub reduction: f64,
    /// The prior's variance.
    pub variance: f64,
}

impl Innovation {
    /// Bayes' rule (eq. 5) for `state` at a cell of some probabilities, with `P(y | x)` of shape `[S, O]`; `None` if the
    /// observation is impossible.
    pub fn of(prior: &[f64], likelihood: &Array2<f64>, state: usize, observed: u8) -> Option<Self> {
        let (n_observations, before) = (likelihood.ncols(), prior[state]);
        let likelihood = likelihood.as_slice();
        let likelihood = likelihood.expect("invariant: likelihoods are row-major");
        let rows = || prior.iter().zip(likelihood.chunks_exact(n_observations));
        let evidence = |value: usize| -> f64 { rows().map(|(p, row)| p * row[value]).sum() };
        let own = &likelihood[state * n_observations..];
        let change = |value: usize, evidence: f64| own[value] * before / evidence - before;
        let reduction = |value: usize| match evidence(value) {
            all if all > 0.0 => all * change(value, all).powi(2),
            _ => 0.0,
        };
        let seen = usize::from(observed);
        // Of a sensor with several matrices side by side, the one by which the cell was seen.
        let n_matrices = own[..n_observations].iter().sum::<f64>().round().max(1.0) as usize;
        let of_matrix = n_observations / n_matrices;
        let matrix = seen / of_matrix * of_matrix..(seen / of_matrix + 1) * of_matrix;
        let evidence = evidence(seen);
        (evidence > 0.0).then(|| Self {
            evidence,
            value: change(seen, evidence),
            reduction: matrix.map(reduction).sum(),
            variance: (before * (1.0 - before)).max(LEAST_VARIANCE),
        })
    }
}
