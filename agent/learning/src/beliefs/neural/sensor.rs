//! From what cells show to what they are, through a sensor with a known observation matrix.

use emberwatch_model::grid::Probabilities;
use ndarray::{Array2, Axis, s};

/// What is traced back to a state is at least this.
const LEAST: f64 = 1e-6;

/// Turns the distribution of what each cell shows into that of what it is, by the inverse of `P(y | x)`. No state is ruled
/// out, as what a network predicts is no exact mixture of what states show.
pub fn trace_back(shown: &mut Probabilities, inverse: &Array2<f64>) {
    let (n, height, width) = shown.dim();
    let mut states = vec![0.0; n];
    for (row, col) in (0..height * width).map(|cell| (cell / width, cell % width)) {
        for (state, p) in states.iter_mut().enumerate() {
            let parts =
                (0..n).map(|seen| f64::from(shown[[seen, row, col]]) * inverse[[seen, state]]);
            *p = parts.sum::<f64>().max(LEAST);
        }
        let total: f64 = states.iter().sum();
        for (state, p) in states.iter().enumerate() {
            shown[[state, row, col]] = (p / total) as f32;
        }
    }
}

/// The inverse of a square matrix, by Gauss and Jordan's elimination with pivots; `None` if it has none.
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
