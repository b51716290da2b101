//! Bayes' rule at one cell, and its effect on the probability of one state.

use ndarray::Array2;

const LEAST_VARIANCE: f64 = 1e-9;

/// The effect of an observation on the probability of one state of the observed cell.
#[derive(Debug, Clone, Copy)]
pub struct Innovation {
    /// The probability of the observation, above 0.
    pub evidence: f64,
    /// Posterior minus prior probability of the state.
    pub value: f64,
    /// The expected reduction of the state's variance by an observation of the cell.
    pub reduction: f64,
    /// The variance `p (1 - p)` of the state under the prior, at least [`LEAST_VARIANCE`].
    pub variance: f64,
}

impl Innovation {
    /// Computes the effect of an observation on `state` by Bayes' rule (eq. 5). `prior` contains the cell's
    /// probabilities, and `likelihood` is `P(y | x)`, shape `[S, O]`. Returns `None` if the observation is impossible.
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
        let evidence = evidence(seen);
        (evidence > 0.0).then(|| Self {
            evidence,
            value: change(seen, evidence),
            reduction: (0..n_observations).map(reduction).sum(),
            variance: (before * (1.0 - before)).max(LEAST_VARIANCE),
        })
    }
}
