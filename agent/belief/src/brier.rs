//! How well a belief fits the hidden states.

use crate::estimation::belief::Belief;
use emberwatch_model::Grid;

/// Brier score of a belief: the mean over all cells of `(p - 1[x = target])^2`, where `p` is the
/// probability of the state that pays most, which the belief numbers `own`. 0 is perfect; the share
/// `q` of such cells, told of each cell alike, scores `q (1 - q)`.
pub fn brier_score(belief: &Belief, truth: &Grid<u8>, target: usize, own: usize) -> f64 {
    let squared = |(&p, &state): (&f32, &u8)| {
        let miss = f64::from(p) - f64::from(u8::from(usize::from(state) == target));
        miss * miss
    };
    let sum: f64 = belief.probability(own).iter().zip(truth).map(squared).sum();
    sum / truth.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberwatch_model::Shape;

    #[test]
    fn a_brier_score_is_the_mean_squared_miss() {
        let shape = Shape::new(1, 4).expect("test shape");
        let truth = Grid::from_shape_vec((1, 4), vec![2, 0, 1, 0]).expect("test grid");
        let certain = Belief::from_states(&truth, 3).expect("test states");
        assert_eq!(brier_score(&certain, &truth, 2, 2), 0.0);
        let uniform = Belief::uniform(3, shape);
        let expected = (4.0 / 9.0 + 3.0 / 9.0) / 4.0;
        assert!((brier_score(&uniform, &truth, 2, 0) - expected).abs() < 1e-6);
    }
}
