//! The transition operator `Phi` on beliefs: the predictor `u_{k+1} = Phi(p_k)` of paper eqs. 2-4.
//!
//! `phi[m, i, j] = b[m] + sum_n sum_{a,c} w[m, n, a, c] * x[n, i + a - A, j + c - C]` with `(A, C)`
//! the centre of the kernel and `x` zero outside the grid (eq. 2: a cross-correlation, not a flipped
//! convolution), then divided by its sum over `m` (eq. 3). [`super::dynamics`] draws realised states
//! from the same operator.
//!
//! Where the weights see the cell's own state `o`, `phi[m | o]` has the weights of `o`, and its centre tap
//! sees `o` itself: `u[m] = sum_o p[o] phi[m | o] / sum_m phi[m | o]`. This is a mean field: it takes the
//! cell and its neighbours for independent, as the filter does.
//!
//! Two things make it fast, both without a change of meaning. The belief is copied into planes with
//! a margin of zeros, so no cell is special. And taps of one state that weigh alike (the eight
//! neighbours in most of the wildfire kernel) are added up before they are multiplied, once for all
//! next states: 35 additions and 16 multiplications a cell where the sum above has 54 of each.
//! Every lane does the same operations in the same order and none is fused, so results are
//! bit-identical on every platform.

use super::file::ModelError;
use super::grid::Shape;
use super::parameters::Model;
use super::vectors::vectorised;
use ndarray::{Array3, Array4, NdFloat, s};

/// Cells computed at once, four AVX2 registers of `f32`. Independent sums hide the latency of adds.
const LANES: usize = 32;

/// `Phi` for one model on one grid, with its work space: give each thread its own clone.
///
/// `f32` is what everything uses; `f64` is for checks.
#[derive(Debug, Clone)]
pub struct Transition<T = f32> {
    shape: Shape,
    n_states: usize,
    layout: Layout,
    /// Groups of taps that weigh alike: where each reads, relative to a cell's place in `planes`.
    groups: Vec<Vec<usize>>,
    kernels: Kernels<T>,
    /// The belief with a margin of zeros.
    planes: Vec<T>,
    /// The inputs of each group, added up.
    sums: Vec<[T; LANES]>,
    /// The weight of each next state, before eq. 3 divides.
    weights: Vec<[T; LANES]>,
    /// The same in one own state.
    own_weights: Vec<[T; LANES]>,
}

/// For each next state its bias and its weight for some of the groups.
type Rows<T> = Vec<Row<T>>;

#[derive(Debug, Clone)]
enum Kernels<T> {
    /// Of every cell.
    Alike(Rows<T>),
    /// By the cell's own state.
    Own(Vec<Own<T>>),
}

/// What a cell in one state itself turns into.
#[derive(Debug, Clone)]
enum Own<T> {
    /// Whatever its neighbours, the probability of each next state that is possible.
    Fixed(Vec<(usize, T)>),
    /// The rows of the next states that are possible.
    Weighed(Vec<(usize, Row<T>)>),
}

/// One next state's part of eq. 2.
#[derive(Debug, Clone)]
struct Row<T> {
    bias: T,
    /// Group and weight.
    terms: Vec<(usize, T)>,
}

/// Where a cell of a state lies in the planes: half a kernel of margin on each side, and on the
/// right up to a whole number of [`LANES`].
#[derive(Debug, Clone, Copy)]
struct Layout {
    above: usize,
    left: usize,
    stride: usize,
    plane: usize,
}

impl<T: NdFloat> Transition<T> {
    /// Lays out a model's operator for a grid.
    ///
    /// # Errors
    /// [`ModelError::ZeroWeight`] where eq. 3 could divide by zero ([`Model::check_on`]).
    pub fn new(model: &Model, shape: Shape) -> Result<Self, ModelError> {
        model.check_on(shape)?;
        let bias = model.bias().to_vec();
        Ok(Self::of_weights(model.kernels(), &bias, shape))
    }

    /// Lays out weights `w[m, n, a, c]`, shape `[S, S, KH, KW]` with odd sides, and biases `b[m]` for a grid:
    /// one kernel for all cells, or one for each state that a cell itself can be in.
    /// All are finite and 0 or more; where a cell's weights can all be 0, its prediction is NaN.
    pub fn of_weights(kernels: &[Array4<f64>], bias: &[f64], shape: Shape) -> Self {
        let (n_states, _, kernel_height, kernel_width) = kernels[0].dim();
        let layout = Layout::new(shape, kernel_height, kernel_width);
        let sees_own_state = kernels.len() > 1;
        let (columns, groups): (Vec<_>, Vec<_>) =
            taps_that_weigh_alike(kernels, layout).into_iter().unzip();
        let rows = |own: usize| rows(own, &kernels[own], bias, sees_own_state, &columns);
        let kernels = if sees_own_state {
            Kernels::Own((0..n_states).map(|own| Own::new(rows(own))).collect())
        } else {
            Kernels::Alike(rows(0))
        };
        Self {
            shape,
            n_states,
            layout,
            planes: vec![T::zero(); n_states * layout.plane],
            sums: vec![[T::zero(); LANES]; groups.len()],
            weights: vec![[T::zero(); LANES]; n_states],
            own_weights: vec![[T::zero(); LANES]; n_states],
            groups,
            kernels,
        }
    }

    /// Writes `Phi(belief)` to `out`, both `[S, H, W]`; each cell of the belief must sum to one.
    ///
    /// # Panics
    /// If an array has another shape or is not row-major.
    pub fn apply(&mut self, belief: &Array3<T>, out: &mut Array3<T>) {
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

    /// Copies the belief inside the margins.
    fn load(&mut self, belief: &[T]) {
        let (Layout { above, left, .. }, width) = (self.layout, self.shape.width());
        let states = belief.chunks_exact(self.shape.n_cells());
        for (cells, plane) in states.zip(self.planes.chunks_exact_mut(self.layout.plane)) {
            let rows = plane.chunks_exact_mut(self.layout.stride).skip(above);
            for (from, to) in cells.chunks_exact(width).zip(rows) {
                to[left..left + width].copy_from_slice(from);
            }
        }
    }

    /// Eq. 2 for the [`LANES`] cells from place `at` on.
    #[inline(always)] // As are its parts, to be compiled for the vectors of this processor.
    fn weigh(&mut self, at: usize) {
        for (sum, offsets) in self.sums.iter_mut().zip(&self.groups) {
            *sum = add_up(&self.planes[at..], offsets);
        }
        match &self.kernels {
            Kernels::Alike(rows) => {
                for (weight, row) in self.weights.iter_mut().zip(rows) {
                    *weight = row.weigh(&self.sums);
                }
            }
            Kernels::Own(kernels) => {
                self.weights.fill([T::zero(); LANES]);
                let centre = at + self.layout.above * self.layout.stride + self.layout.left;
                for (plane, own) in self.planes.chunks_exact(self.layout.plane).zip(kernels) {
                    let p = lanes_from(plane, centre);
                    own.add(p, &self.sums, &mut self.own_weights, &mut self.weights);
                }
            }
        }
    }

    /// Eq. 3 for the cells from `(row, col)` on, as far as the grid goes.
    #[inline(always)]
    fn store(&self, row: usize, col: usize, out: &mut [T]) {
        let mut total = [T::zero(); LANES];
        for weight in &self.weights {
            for (total, &weight) in total.iter_mut().zip(weight) {
                *total += weight;
            }
        }
        let factor = total.map(|total| T::one() / total);
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

impl Layout {
    fn new(shape: Shape, kernel_height: usize, kernel_width: usize) -> Self {
        let stride = shape.width().next_multiple_of(LANES) + kernel_width - 1;
        Self {
            above: kernel_height / 2,
            left: kernel_width / 2,
            stride,
            plane: (shape.height() + kernel_height - 1) * stride,
        }
    }
}

impl<T: NdFloat> Own<T> {
    fn new(rows: Rows<T>) -> Self {
        let sees_neighbours = rows.iter().any(|row| !row.terms.is_empty());
        let total = rows.iter().fold(T::zero(), |sum, row| sum + row.bias);
        let is_possible = |row: &Row<T>| row.bias > T::zero() || !row.terms.is_empty();
        let possible = rows.into_iter().enumerate();
        let possible = possible.filter(|(_, row)| is_possible(row));
        if sees_neighbours {
            Self::Weighed(possible.collect())
        } else {
            Self::Fixed(possible.map(|(to, row)| (to, row.bias / total)).collect())
        }
    }

    /// Adds what becomes of the cells that are in this state with probability `p`.
    #[inline(always)]
    fn add(
        &self,
        p: &[T; LANES],
        sums: &[[T; LANES]],
        weights: &mut [[T; LANES]],
        next: &mut [[T; LANES]],
    ) {
        match self {
            Self::Fixed(probabilities) => {
                for &(to, probability) in probabilities {
                    for (next, &p) in next[to].iter_mut().zip(p) {
                        *next += p * probability;
                    }
                }
            }
            Self::Weighed(rows) => {
                let mut total = [T::zero(); LANES];
                for (weight, (_, row)) in weights.iter_mut().zip(rows) {
                    *weight = row.weigh(sums);
                    for (total, &weight) in total.iter_mut().zip(&*weight) {
                        *total += weight;
                    }
                }
                let mut factor = *p;
                for (factor, total) in factor.iter_mut().zip(total) {
                    *factor /= total;
                }
                for ((to, _), weight) in rows.iter().zip(weights) {
                    let lanes = next[*to].iter_mut().zip(&*weight).zip(&factor);
                    for ((next, &weight), &factor) in lanes {
                        *next += weight * factor;
                    }
                }
            }
        }
    }
}

impl<T: NdFloat> Row<T> {
    #[inline(always)]
    fn weigh(&self, sums: &[[T; LANES]]) -> [T; LANES] {
        let mut weight = [self.bias; LANES];
        for &(group, factor) in &self.terms {
            for (weight, &sum) in weight.iter_mut().zip(&sums[group]) {
                *weight += factor * sum;
            }
        }
        weight
    }
}

/// Eq. 2 for the cells in state `own`, or for all; `columns` are the weights of the groups.
fn rows<T: NdFloat>(
    own: usize,
    kernel: &Array4<f64>,
    bias: &[f64],
    sees_own_state: bool,
    columns: &[Vec<f64>],
) -> Rows<T> {
    // Eq. 3 cancels a common factor; taken out, no weight overflows T.
    let largest = kernel.iter().chain(bias).copied().fold(0.0, f64::max);
    let scaled = |weight: f64| T::from(weight / largest).expect("invariant: f64 casts to T");
    let (n_states, _, height, width) = kernel.dim();
    let row = |to: usize| {
        let centre = kernel[[to, own, height / 2, width / 2]];
        let weights = columns.iter().map(|column| column[own * n_states + to]);
        let terms = weights.enumerate().filter(|&(_, weight)| weight > 0.0);
        Row {
            bias: scaled(bias[to] + if sees_own_state { centre } else { 0.0 }),
            terms: terms
                .map(|(group, weight)| (group, scaled(weight)))
                .collect(),
        }
    };
    (0..n_states).map(row).collect()
}

/// The [`LANES`] values from a place on.
#[inline(always)]
fn lanes_from<T>(planes: &[T], at: usize) -> &[T; LANES] {
    planes[at..]
        .first_chunk()
        .expect("invariant: the layout has room for LANES cells at every tap")
}

/// The sum of the [`LANES`] values at each of the offsets.
#[inline(always)]
fn add_up<T: NdFloat>(planes: &[T], offsets: &[usize]) -> [T; LANES] {
    let mut sum = [T::zero(); LANES];
    for &offset in offsets {
        for (sum, &lane) in sum.iter_mut().zip(lanes_from(planes, offset)) {
            *sum += lane;
        }
    }
    sum
}

/// The taps of each state, or of all, by the column of weights `w[.., n, a, c]` they share, one kernel's after the
/// other's: `(column, offsets)`. Taps without weight are left out, as is the centre where it sees the
/// cell's own state.
fn taps_that_weigh_alike(kernels: &[Array4<f64>], layout: Layout) -> Vec<(Vec<f64>, Vec<usize>)> {
    let (n_states, _, kernel_height, kernel_width) = kernels[0].dim();
    let is_own = |tap| kernels.len() > 1 && tap == (kernel_height / 2, kernel_width / 2);
    let mut groups: Vec<(Vec<f64>, Vec<usize>)> = Vec::new();
    for from in 0..n_states {
        // Sums within one state alone keep what all kernels alike have always predicted, to the bit.
        let first = if kernels.len() > 1 { 0 } else { groups.len() };
        for (row, col) in (0..kernel_height).flat_map(|a| (0..kernel_width).map(move |c| (a, c))) {
            let columns = kernels
                .iter()
                .map(|kernel| kernel.slice(s![.., from, row, col]));
            let column: Vec<f64> = columns.flat_map(|column| column.to_vec()).collect();
            if is_own((row, col)) || column.iter().all(|&weight| weight == 0.0) {
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
