//! The transition operator `Phi` on beliefs: the predictor `u_{k+1} = Phi(p_k)` of paper eqs. 2-4.
//!
//! `phi[m, i, j] = b[m] + sum_n sum_{a,c} w[m, n, a, c] * x[n, i + a - A, j + c - C]` where `(A, C)` is the centre of
//! the kernel (eq. 2 is a cross-correlation, not a flipped convolution). Outside the grid `x` is 1 for the model's
//! `edge` state and 0 otherwise. Eq. 3 divides `phi` by its sum over `m`. [`super::dynamics`] draws states from the
//! same operator.
//!
//! If the kernels depend on the cell's own state `o`, `phi[m | o]` has the weights of `o`, and the cell at the centre
//! of the kernel is in state `o`. Then `u[m] = sum_o p[o] phi[m | o] / sum_m phi[m | o]`. This is a mean-field
//! approximation: it assumes that the cell and its neighbours are independent, as the filter does.
//!
//! If the model has zones, each cell has the weights of its zone.
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

use super::file::ModelError;
use super::grid::{Grid, Shape};
use super::parameters::Model;
use super::vectors::{LANES, vectorised};
use super::zoned::ZonedNumbers;
use layout::Layout;
use ndarray::{Array3, Array4, NdFloat};
use rows::{Kernels, Own, kernel_rows, taps_that_weigh_alike};
use std::sync::Arc;

/// The operator `Phi` for one model on one grid, with its buffers. Each thread needs its own clone.
///
/// The programs use `f32`; tests also use `f64`.
#[derive(Debug, Clone)]
pub struct Transition<T = f32> {
    shape: Shape,
    n_states: usize,
    layout: Layout,
    /// Groups of taps with equal weights. Each tap is stored as an offset from a cell's place in `planes`.
    groups: Vec<Vec<usize>>,
    kernels: Kernels<T>,
    /// The weights that differ between zones.
    slots: Arc<ZonedNumbers<T>>,
    /// The belief, one plane per state. Margins are 1 in the plane of the model's edge state, and 0 in the other
    /// planes.
    planes: Vec<T>,
    /// The sum of the beliefs at the taps of each group.
    sums: Vec<[T; LANES]>,
    /// The weight of each next state, before the division of eq. 3.
    weights: Vec<[T; LANES]>,
    /// The weight of each next state given one own state.
    own_weights: Vec<[T; LANES]>,
}

impl<T: NdFloat> Transition<T> {
    /// Prepares a model's operator for a grid.
    ///
    /// # Errors
    /// [`ModelError::ZeroWeight`] if eq. 3 could divide by zero in some cell ([`Model::check_on`]).
    pub fn new(model: &Model, shape: Shape) -> Result<Self, ModelError> {
        model.check_on(shape)?;
        let bias = model.bias().to_vec();
        let land = (model.zone_map().map(|map| &**map), model.n_zones());
        let mut transition = Self::on_land(model.kernels(), &bias, shape, land);
        if let Some(edge) = model.edge() {
            // `load` replaces the values inside the margins.
            let planes = &mut transition.planes;
            planes[edge * transition.layout.plane..][..transition.layout.plane].fill(T::one());
        }
        Ok(transition)
    }

    /// Prepares the operator for a grid from weights `w[m, n, a, c]`, shape `[S, S, KH, KW]` with odd `KH` and `KW`,
    /// and biases `b[m]`.
    ///
    /// `kernels` contains one kernel, or one for each own state (the state of the cell itself). All weights must be
    /// finite and 0 or more. If all weights of a cell are 0, its prediction is NaN.
    pub fn of_weights(kernels: &[Array4<f64>], bias: &[f64], shape: Shape) -> Self {
        Self::on_land(kernels, bias, shape, (None, 1))
    }

    /// Prepares the operator as [`Self::of_weights`] does, but with kernels for each zone. The map contains the zone of
    /// each cell, shape `[H, W]`.
    fn on_land(
        kernels: &[Array4<f64>],
        bias: &[f64],
        shape: Shape,
        (zones, n_zones): (Option<&Grid<u8>>, usize),
    ) -> Self {
        let (n_states, _, kernel_height, kernel_width) = kernels[0].dim();
        let layout = Layout::new(shape, kernel_height, kernel_width);
        let n_own = kernels.len() / n_zones;
        let (columns, groups): (Vec<_>, Vec<_>) = taps_that_weigh_alike(kernels, n_own > 1, layout)
            .into_iter()
            .unzip();
        let mut slots = Vec::new();
        let mut rows = |own: usize| {
            let of_zones: Vec<_> = kernels.iter().skip(own).step_by(n_own).collect();
            kernel_rows(own, &of_zones, bias, n_own, &columns, &mut slots)
        };
        let kernels = if n_own > 1 {
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
            slots: Arc::new(ZonedNumbers::new(&slots, zones)),
        }
    }

    /// Writes `Phi(belief)` to `out`. Both have shape `[S, H, W]`. The probabilities of each cell in the belief must
    /// sum to one.
    ///
    /// # Panics
    /// If an array has a different shape or is not row-major.
    pub fn apply(&mut self, belief: &Array3<T>, out: &mut Array3<T>) {
        let dim = (self.n_states, self.shape.height(), self.shape.width());
        assert_eq!(belief.dim(), dim, "belief: expected [S, H, W]");
        assert_eq!(out.dim(), dim, "predictor: expected [S, H, W]");
        self.load(belief.as_slice().expect("belief: expected row-major"));
        let out = out.as_slice_mut().expect("predictor: expected row-major");
        vectorised(
            #[inline(always)]
            || {
                let mut chunk = 0;
                for row in 0..self.shape.height() {
                    for col in (0..self.shape.width()).step_by(LANES) {
                        self.weigh(row * self.layout.stride + col, chunk);
                        self.store(row, col, out);
                        chunk += 1;
                    }
                }
            },
        );
    }

    /// Copies the belief into the planes, inside the margins.
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

    /// Computes eq. 2 for the [`LANES`] cells of a chunk that begins at place `at`.
    #[inline(always)] // Like the functions it calls, so that all are compiled for this processor's vectors.
    fn weigh(&mut self, at: usize, chunk: usize) {
        let slots = self.slots.of_chunk(chunk);
        for (sum, offsets) in self.sums.iter_mut().zip(&self.groups) {
            *sum = add_up(&self.planes[at..], offsets);
        }
        match &self.kernels {
            Kernels::Alike(rows) => {
                for (weight, row) in self.weights.iter_mut().zip(rows) {
                    *weight = row.weigh(&self.sums, slots);
                }
            }
            Kernels::Own(kernels) => {
                self.weights.fill([T::zero(); LANES]);
                let centre = at + self.layout.above * self.layout.stride + self.layout.left;
                for (plane, own) in self.planes.chunks_exact(self.layout.plane).zip(kernels) {
                    let p = lanes_from(plane, centre);
                    let sums = (&self.sums[..], slots);
                    own.add(p, sums, &mut self.own_weights, &mut self.weights);
                }
            }
        }
    }

    /// Computes eq. 3 for the cells of a chunk that begins at `(row, col)`, up to the edge of the grid.
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

    /// Returns the approximate memory in bytes: the belief with margins, and the buffers.
    pub fn memory_bytes(&self) -> usize {
        let n_lanes = self.sums.len() + self.weights.len() + self.own_weights.len();
        let work = n_lanes * size_of::<[T; LANES]>();
        size_of_val(&*self.planes) + work + self.slots.memory_bytes()
    }
}

/// Returns the [`LANES`] values that begin at a place.
#[inline(always)]
fn lanes_from<T>(planes: &[T], at: usize) -> &[T; LANES] {
    planes[at..]
        .first_chunk()
        .expect("invariant: the layout has LANES cells from every tap on")
}

/// Returns the sum of the [`LANES`] values at several offsets.
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
