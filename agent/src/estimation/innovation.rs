//! Bayes' rule at one cell, and what it does to the probability of one state.

use ndarray::{Array2, ArrayView1};

/// A variance that is divided by is at least this.
const LEAST_VARIANCE: f64 = 1e-9;

/// What an observation does to a cell's paying state.
#[derive(Debug, Clone)]
pub struct Innovation {
    /// One probability per state.
    pub posterior: Vec<f64>,
    /// Posterior minus prior probability.
    pub value: f64,
    /// What seeing the cell takes off the variance, on average over observations.
    pub reduction: f64,
    /// The prior's variance.
    pub variance: f64,
}

impl Innovation {
    /// Bayes' rule (eq. 5) at a cell of some probabilities, with `P(y | x)` of shape `[S, O]`; `None` if the observation
    /// is impossible.
    pub fn of(prior: &[f64], likelihood: &Array2<f64>, state: usize, observed: u8) -> Option<Self> {
        let evidence = |column: ArrayView1<'_, f64>| -> f64 {
            prior.iter().zip(column).map(|(p, b)| p * b).sum()
        };
        let seen_as = likelihood.column(usize::from(observed));
        let sum = evidence(seen_as);
        if sum <= 0.0 {
            return None;
        }
        let before = prior[state];
        let squares = likelihood.columns().into_iter().map(|column| {
            let all = evidence(column);
            let change = column[state] * before / all - before;
            if all > 0.0 {
                all * change * change
            } else {
                0.0
            }
        });
        let posterior: Vec<f64> = prior
            .iter()
            .zip(seen_as)
            .map(|(p, b)| p * b / sum)
            .collect();
        Some(Self {
            value: posterior[state] - before,
            reduction: squares.sum(),
            variance: (before * (1.0 - before)).max(LEAST_VARIANCE),
            posterior,
        })
    }
}
