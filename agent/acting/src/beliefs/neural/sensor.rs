//! Converts predicted observations to states by the inverse of a known observation matrix.

use emberwatch_model::grid::Probabilities;
use ndarray::{Array2, Axis, s};

/// Minimum probability of a state before normalisation.
const MIN_PROBABILITY: f64 = 1e-6;

/// Replaces each cell's distribution over observations, `[O, H, W]`, with its distribution over states.
///
/// `inverse` is the inverse of `P(y | x)`. For some predictions of a network, the result has negative values. They are
/// raised to a small minimum, and the result is normalised.
pub fn states_from_observations(probabilities: &mut Probabilities, inverse: &Array2<f64>) {
    let (n, height, width) = probabilities.dim();
    let mut states = vec![0.0; n];
    for (row, col) in (0..height * width).map(|cell| (cell / width, cell % width)) {
        for (state, p) in states.iter_mut().enumerate() {
            let parts = (0..n)
                .map(|seen| f64::from(probabilities[[seen, row, col]]) * inverse[[seen, state]]);
            *p = parts.sum::<f64>().max(MIN_PROBABILITY);
        }
        let total: f64 = states.iter().sum();
        for (state, p) in states.iter().enumerate() {
            probabilities[[state, row, col]] = (p / total) as f32;
        }
    }
}

/// Inverts a square matrix by Gauss-Jordan elimination with pivoting. Returns `None` if it is singular.
pub fn inverse(matrix: &Array2<f64>) -> Option<Array2<f64>> {
    let n = matrix.nrows();
    let mut both = ndarray::concatenate![Axis(1), *matrix, Array2::<f64>::eye(n)];
    for col in 0..n {
        let size = |row: &usize| both[[*row, col]].abs();
        let pivot = (col..n).max_by(|a, b| size(a).total_cmp(&size(b)))?;
        if size(&pivot) < 1e-9 {
            return None;
        }
        (0..2 * n).for_each(|at| both.swap([col, at], [pivot, at]));
        let own = &both.row(col) / both[[col, col]];
        for row in 0..n {
            let factor = if row == col { 0.0 } else { both[[row, col]] };
            both.row_mut(row).scaled_add(-factor, &own);
        }
        both.row_mut(col).assign(&own);
    }
    Some(both.slice(s![.., n..]).to_owned())
}
