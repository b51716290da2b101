//! The transition operator `Phi` on beliefs: the predictor `u_{k+1} = Phi(p_k)` of paper eqs. 2-4.
//!
//! `phi[m, i, j] = b[m] + sum_n sum_{a,c} w[m, n, a, c] * x[n, i + a - A, j + c - C]` where `(A, C)` is the centre of
//! the kernel (eq. 2 is a cross-correlation, not a flipped convolution). Outside the grid `x` is 1 for the model's
//! `edge` state and 0 otherwise. Eq. 3 divides `phi` by its sum over `m`. [`super::dynamics`] draws states from the
//! same operator.
//!
//! `tests/model/models.rs` computes these sums directly, and `tests/model/transition.rs` compares the results for
//! random models and grids.
//!
//! Two optimisations leave the results unchanged. The belief is copied into planes with a margin, so that cells at the
//! edge need no special treatment, and many cells are computed at once. In addition, the beliefs at taps with equal
//! weights are added before they are multiplied (`rows.rs`). Every lane performs the same operations in the same order,
//! and no operation is fused, so results are bit-identical on every platform.

mod layout;
mod rows;

use super::grid::{Probabilities, Shape};
use super::vectors::{LANES, vectorised};
use layout::Layout;
use ndarray::Array4;
use rows::{Lanes, Row, kernel_rows, taps_that_weigh_alike};

/// The operator `Phi` for one kernel on one grid, with its buffers. Each thread needs its own clone.
#[derive(Debug, Clone)]
pub struct Transition {
    shape: Shape,
    n_states: usize,
    layout: Layout,
    /// Groups of taps with equal weights. Each tap is stored as an offset from a cell's place in `planes`.
    groups: Vec<Vec<usize>>,
    rows: Vec<Row>,
    /// The belief, one plane per state. Margins are 1 in the plane of the model's edge state, and 0 in the other
    /// planes.
    planes: Vec<f32>,
    /// The sum of the beliefs at the taps of each group.
    sums: Vec<Lanes>,
    weights: Vec<Lanes>,
}

impl Transition {
    /// Prepares the operator for a grid from weights `w[m, n, a, c]`, shape `[S, S, KH, KW]` with odd `KH` and `KW`, and
    /// biases `b[m]`. `edge` is the state of all cells outside the grid; without it, these cells add no weight.
    ///
    /// All weights must be finite and 0 or more. If all weights of a cell are 0, its prediction is NaN.
    pub fn new(kernel: &Array4<f64>, bias: &[f64], edge: Option<usize>, shape: Shape) -> Self {
        let (n_states, _, height, width) = kernel.dim();
        let layout = Layout::new(shape, height, width);
        let (columns, groups): (Vec<_>, Vec<_>) =
            taps_that_weigh_alike(kernel, layout).into_iter().unzip();
        let mut planes = vec![0.0; n_states * layout.plane];
        if let Some(edge) = edge {
            // `load` replaces the values inside the margins.
            planes[edge * layout.plane..][..layout.plane].fill(1.0);
        }
        Self {
            shape,
            n_states,
            layout,
            planes,
            sums: vec![[0.0; LANES]; groups.len()],
            weights: vec![[0.0; LANES]; n_states],
            groups,
            rows: kernel_rows(kernel, bias, &columns),
        }
    }

    /// Writes `Phi(belief)` to `out`. Both have shape `[S, H, W]`. The probabilities of each cell in the belief must
    /// sum to one.
    ///
    /// # Panics
    /// If an array has a different shape or is not row-major.
    pub fn apply(&mut self, belief: &Probabilities, out: &mut Probabilities) {
        let dim = (self.n_states, self.shape.height(), self.shape.width());
        assert_eq!(belief.dim(), dim, "belief: expected [S, H, W]");
        assert_eq!(out.dim(), dim, "predictor: expected [S, H, W]");
        self.load(belief.as_slice().expect("belief: expected row-major"));
        let out = out.as_slice_mut().expect("predictor: expected row-major");
        vectorised(
            #[inline(always)]
            || {
                for row in 0..self.shape.height() {
                    for col in (0..self.shape.width()).step_by(LANES) {
                        self.weigh(row * self.layout.stride + col);
                        self.store(row, col, out);
                    }
                }
            },
        );
    }

    fn load(&mut self, belief: &[f32]) {
        let (Layout { above, left, .. }, width) = (self.layout, self.shape.width());
        let states = belief.chunks_exact(self.shape.n_cells());
        for (cells, plane) in states.zip(self.planes.chunks_exact_mut(self.layout.plane)) {
            let rows = plane.chunks_exact_mut(self.layout.stride).skip(above);
            for (from, to) in cells.chunks_exact(width).zip(rows) {
                to[left..left + width].copy_from_slice(from);
            }
        }
    }

    /// Computes eq. 2 for the [`LANES`] cells of a chunk that begins at place `at`.
    #[inline(always)] // Like the functions it calls, so that all are compiled for this processor's vectors.
    fn weigh(&mut self, at: usize) {
        for (sum, offsets) in self.sums.iter_mut().zip(&self.groups) {
            *sum = add_up(&self.planes[at..], offsets);
        }
        for (weight, row) in self.weights.iter_mut().zip(&self.rows) {
            *weight = row.weigh(&self.sums);
        }
    }

    /// Computes eq. 3 for the cells of a chunk that begins at `(row, col)`, up to the edge of the grid.
    #[inline(always)]
    fn store(&self, row: usize, col: usize, out: &mut [f32]) {
        let mut total = [0.0; LANES];
        for weight in &self.weights {
            for (total, &weight) in total.iter_mut().zip(weight) {
                *total += weight;
            }
        }
        let factor = total.map(|total| 1.0 / total);
        let width = self.shape.width();
        for (weight, plane) in self
            .weights
            .iter()
            .zip(out.chunks_mut(width * self.shape.height()))
        {
            let mut lanes = *weight;
            for (lane, &factor) in lanes.iter_mut().zip(&factor) {
                *lane *= factor;
            }
            let cells = &mut plane[row * width..][col..width];
            match cells.first_chunk_mut() {
                Some(cells) => *cells = lanes,
                None => cells.copy_from_slice(&lanes[..cells.len()]),
            }
        }
    }
}

#[inline(always)]
fn lanes_from(planes: &[f32], at: usize) -> &Lanes {
    planes[at..]
        .first_chunk()
        .expect("invariant: the layout has LANES cells from every tap on")
}

#[inline(always)]
fn add_up(planes: &[f32], offsets: &[usize]) -> Lanes {
    let mut sum = [0.0; LANES];
    for &offset in offsets {
        for (sum, &lane) in sum.iter_mut().zip(lanes_from(planes, offset)) {
            *sum += lane;
        }
    }
    sum
}
