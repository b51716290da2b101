//! Scores of a belief against the hidden states.

use crate::estimation::belief::Belief;
use emberwatch_model::Grid;

/// Computes the Brier score of one state: the mean over all cells of `(p - 1[x = target])^2`.
///
/// `p` is the believed probability of the state. This state has index `target` in `truth` and index `own` in the
/// belief. A perfect belief scores 0. If a fraction `q` of the cells is in the state, a belief with `p = q` in every
/// cell scores `q (1 - q)`.
pub fn brier_score(belief: &Belief, truth: &Grid<u8>, target: usize, own: usize) -> f64 {
    let squared = |(&p, &state): (&f32, &u8)| {
        let miss = f64::from(p) - f64::from(u8::from(usize::from(state) == target));
        miss * miss
    };
    let sum: f64 = belief.probability(own).iter().zip(truth).map(squared).sum();
    sum / truth.len() as f64
}

/// Computes the log loss: the mean over all cells of `-ln p` in nats, where `p` is the believed probability of the
/// cell's true state.
///
/// The log loss is infinite if `p` is 0 in some cell.
///
/// # Panics
/// If `truth` contains a state that the belief lacks.
pub fn log_loss(belief: &Belief, truth: &Grid<u8>) -> f64 {
    let log = |((row, col), &state): ((usize, usize), &u8)| {
        let probability = belief.probabilities()[[usize::from(state), row, col]];
        f64::from(probability).ln()
    };
    let sum: f64 = truth.indexed_iter().map(log).sum();
    // The subtraction returns 0, not -0, for a perfect belief.
    0.0 - sum / truth.len() as f64
}

/// Computes the fraction of cells whose most probable state, the first if several are equal, is the true state.
pub fn accuracy(belief: &Belief, truth: &Grid<u8>) -> f64 {
    let numbers = belief.as_slice();
    let is_right = |&(index, &state): &(usize, &u8)| {
        let states = numbers[index..].iter().step_by(truth.len()).enumerate();
        let best = states.reduce(|best, it| if it.1 > best.1 { it } else { best });
        best.is_some_and(|best| best.0 == usize::from(state))
    };
    let n_right = truth.iter().enumerate().filter(is_right).count();
    n_right as f64 / truth.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberwatch_model::Shape;

    #[test]
    fn scores_compare_the_belief_with_the_true_states() {
        let truth = ndarray::arr2(&[[2, 0, 1, 0]]);
        let other = ndarray::arr2(&[[2, 1, 1, 0]]);
        let certain = Belief::from_states(&truth, 3).expect("test states");
        assert_eq!(brier_score(&certain, &truth, 2, 2), 0.0);
        let scores = |truth| (log_loss(&certain, truth), accuracy(&certain, truth));
        assert_eq!(scores(&truth), (0.0, 1.0));
        assert_eq!(scores(&other), (f64::INFINITY, 0.75));
        let uniform = Belief::uniform(3, Shape::new(1, 4).expect("test shape"));
        let expected = (4.0 / 9.0 + 3.0 / 9.0) / 4.0;
        assert!((brier_score(&uniform, &truth, 2, 0) - expected).abs() < 1e-6);
        assert!((log_loss(&uniform, &truth) - 3.0_f64.ln()).abs() < 1e-6);
        // All states are equally probable, so state 0 is chosen, which is the true state of half the cells.
        assert_eq!(accuracy(&uniform, &truth), 0.5);
    }
}
