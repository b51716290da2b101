//! The log-likelihood of a frame under a predicted belief.

use crate::estimation::belief::Belief;
use emberwatch_model::Frame;
use ndarray::Array2;
use std::ops::AddAssign;

/// The log-likelihood of observations, summed over cells and frames.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Score {
    /// Sum of `ln P(y)`.
    pub log_likelihood: f64,
    pub n_seen: u64,
}

impl Score {
    /// Returns the mean log-likelihood per seen cell, or NaN if no cell was seen.
    pub fn mean(&self) -> f64 {
        self.log_likelihood / self.n_seen as f64
    }
}

impl AddAssign for Score {
    fn add_assign(&mut self, other: Self) {
        self.log_likelihood += other.log_likelihood;
        self.n_seen += other.n_seen;
    }
}

/// Scores a frame under the predictor `u`: the sum of `ln sum_x P(y | x) u(x)` over its observed cells, which are
/// treated as independent. `likelihood` is `P(y | x)`, shape `[S, O]`.
pub fn score(predictor: &Belief, likelihood: &Array2<f64>, frame: &Frame) -> Score {
    let n_cells = predictor.shape().n_cells();
    let numbers = predictor.as_slice();
    let mut score = Score::default();
    for (cell, value) in frame.observed() {
        let states = numbers[cell..].iter().step_by(n_cells);
        let seen_as = likelihood.column(usize::from(value));
        let evidence: f64 = states.zip(seen_as).map(|(&u, b)| f64::from(u) * b).sum();
        score.log_likelihood += evidence.ln();
        score.n_seen += 1;
    }
    score
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberwatch_model::{Model, Shape};

    #[test]
    fn a_score_sums_the_log_probabilities_of_observations() {
        let shape = Shape::new(1, 3).expect("test shape");
        let frame = Frame::from_bytes(shape, 3, &[2, 255, 0]).expect("test frame");
        let belief = Belief::uniform(3, shape);
        let got = score(&belief, Model::wildfire().likelihood(), &frame);
        let expected = (1.04_f64 / 3.0).ln() + (1.79_f64 / 3.0).ln();
        assert!((got.log_likelihood - expected).abs() < 1e-6, "{got:?}");
        assert_eq!(got.n_seen, 2);
        assert!((got.mean() - expected / 2.0).abs() < 1e-6);
    }
}
