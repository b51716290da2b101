//! Computes eq. 2. Beliefs at taps with equal weights are added before they are multiplied.
//!
//! Why it is fast: taps of one state with equal weights (the eight neighbours in most of the wildfire kernel) are added
//! once for all next states. A cell needs 35 additions and 16 multiplications, where the formula has 54 of each.
//!
//! Why the result is the same: `w x + w y = w (x + y)`. `tests/model/models.rs` computes the formula's sums in double
//! precision, and `tests/model/transition.rs` compares the results for random models and grids.

use super::layout::Layout;
use crate::vectors::LANES;
use ndarray::{Array4, s};

/// One value for each cell of a chunk: [`LANES`] consecutive cells of a row.
pub(super) type Lanes = [f32; LANES];

/// Eq. 2 for one next state: its bias, and its weights for groups of taps.
#[derive(Debug, Clone)]
pub(super) struct Row {
    bias: f32,
    terms: Vec<(usize, f32)>,
}

impl Row {
    #[inline(always)]
    pub(super) fn weigh(&self, sums: &[Lanes]) -> Lanes {
        let mut weight = [self.bias; LANES];
        for &(group, factor) in &self.terms {
            for (weight, &sum) in weight.iter_mut().zip(&sums[group]) {
                *weight += factor * sum;
            }
        }
        weight
    }
}

/// Returns the rows of eq. 2, one per next state. `columns` contains the weights of the groups.
pub(super) fn kernel_rows(kernel: &Array4<f64>, bias: &[f64], columns: &[Vec<f64>]) -> Vec<Row> {
    // A common factor cancels in eq. 3. Dividing by the largest weight keeps the weights in the range of `f32`.
    let largest = kernel.iter().chain(bias).copied().fold(0.0, f64::max);
    let scaled = |weight: f64| (weight / largest) as f32;
    let row = |to: usize| {
        let terms = columns.iter().map(|column| scaled(column[to])).enumerate();
        Row {
            bias: scaled(bias[to]),
            terms: terms
                .filter(|(group, _)| columns[*group][to] > 0.0)
                .collect(),
        }
    };
    (0..bias.len()).map(row).collect()
}

/// Groups the taps of each state whose columns of weights `w[.., n, a, c]` are equal. For each group, returns its column
/// and the offsets of its taps. Leaves out taps without weight.
pub(super) fn taps_that_weigh_alike(
    kernel: &Array4<f64>,
    layout: Layout,
) -> Vec<(Vec<f64>, Vec<usize>)> {
    let (n_states, _, height, width) = kernel.dim();
    let mut groups: Vec<(Vec<f64>, Vec<usize>)> = Vec::new();
    for from in 0..n_states {
        let first = groups.len();
        for (row, col) in (0..height).flat_map(|a| (0..width).map(move |c| (a, c))) {
            let column = kernel.slice(s![.., from, row, col]).to_vec();
            if column.iter().all(|&weight| weight == 0.0) {
                continue;
            }
            let offset = from * layout.plane + row * layout.stride + col;
            match groups[first..].iter_mut().find(|group| group.0 == column) {
                Some((_, offsets)) => offsets.push(offset),
                None => groups.push((column, vec![offset])),
            }
        }
    }
    groups
}
