//! The operator `Phi_w` (paper eqs. 2 and 3, without bias) for dense kernels, and its derivatives.
//!
//! Forward, `v[m] = sum_n sum_a w[m, n, a] p[n, . + a]` and `u = v / sum_m v`. Backward, from
//! `g = dL/du`: `h = dL/dv = (g - sum_m g[m] u[m]) / sum_m v`; `dL/dw[m, n, a] = sum_cells h[m]
//! p[n, . + a]`; `dL/dp` is the correlation of `h` with the kernel turned and its states exchanged.
//!
//! [`protocol::Transition`] computes the forward part too; it gains from weights that are zero or
//! alike, of which a learned kernel has none, and does not know derivatives.

use crate::learning::filter::layout::Layout;
use crate::learning::filter::vector::{LANES, Lanes, Real};
use std::array::from_fn;
use std::ops::Range;

/// Next states computed at once: with [`WIDE`] vectors of cells they fill the registers.
const GROUP: usize = 3;

/// Vectors of cells computed at once.
const WIDE: usize = 4;

/// Weights `w[to, from, row, col]` laid out for a grid.
#[derive(Debug, Clone)]
pub(super) struct Operator<T> {
    pub(super) layout: Layout,
    weights: Vec<T>,
    /// `w[from, to, KH - 1 - row, KW - 1 - col]`.
    turned: Vec<T>,
    mask: Vec<T>,
}

impl<T: Real> Operator<T> {
    pub(super) fn new(layout: Layout, weights: &[T]) -> Self {
        let mut operator = Self {
            layout,
            weights: Vec::new(),
            turned: vec![T::zero(); weights.len()],
            mask: layout.mask(),
        };
        operator.set(weights);
        operator
    }

    /// Takes other weights of the same shape.
    pub(super) fn set(&mut self, weights: &[T]) {
        let (n_states, n_taps) = (self.layout.n_states, self.layout.n_taps());
        self.weights = weights.to_vec();
        for to in 0..n_states {
            for from in 0..n_states {
                let straight = &weights[(to * n_states + from) * n_taps..][..n_taps];
                let turned = &mut self.turned[(from * n_states + to) * n_taps..][..n_taps];
                let reversed = straight.iter().rev();
                turned
                    .iter_mut()
                    .zip(reversed)
                    .for_each(|(to, &from)| *to = from);
            }
        }
    }

    /// `u = Phi_w(p)` in planes; `factors` (one plane) gets `1 / sum_m v`, 0 beside the grid.
    #[inline(always)]
    pub(super) fn forward<V: Lanes<T>>(&self, p: &[T], u: &mut [T], factors: &mut [T]) {
        for row in 0..self.layout.shape.height() {
            self.correlate::<V>(&self.weights, p, u, row);
            self.normalise::<V>(u, factors, row);
        }
    }

    /// `h` from `g` and `u`, in some rows and columns.
    #[inline(always)]
    pub(super) fn backward_normalise<V: Lanes<T>>(
        &self,
        g: &[T],
        u: &[T],
        factors: &[T],
        h: &mut [T],
        region: &Region,
    ) {
        let plane = self.layout.plane;
        for row in region.rows.clone() {
            for at in region.places(&self.layout, row) {
                let mut mean = V::splat(T::zero());
                for state in 0..self.layout.n_states {
                    let (g, u) = (
                        load::<T, V>(g, state * plane + at),
                        load(u, state * plane + at),
                    );
                    mean = g.multiply_add(u, mean);
                }
                let factor: V = load(factors, at);
                for state in 0..self.layout.n_states {
                    let g: V = load(g, state * plane + at);
                    store(g.minus(mean).times(factor), h, state * plane + at);
                }
            }
        }
    }

    /// Adds `dL/dw` of some rows and columns of `h` to `gradient`.
    #[inline(always)]
    pub(super) fn add_weight_gradient<V: Lanes<T>>(
        &self,
        p: &[T],
        h: &[T],
        region: &Region,
        gradient: &mut [f64],
    ) {
        let Layout { n_states, .. } = self.layout;
        for from in 0..n_states {
            for kernel_row in 0..self.layout.kernel_height {
                let mut to = 0;
                while to < n_states {
                    let corner = (to, from, kernel_row);
                    match n_states - to {
                        1 => self.taps::<V, 1>(p, h, region, corner, gradient),
                        2 => self.taps::<V, 2>(p, h, region, corner, gradient),
                        _ => self.taps::<V, GROUP>(p, h, region, corner, gradient),
                    }
                    to += GROUP;
                }
            }
        }
    }

    /// `dL/dp` from `h`, in some rows.
    #[inline(always)]
    pub(super) fn backward_correlate<V: Lanes<T>>(&self, h: &[T], g: &mut [T], rows: Range<usize>) {
        for row in rows {
            self.correlate::<V>(&self.turned, h, g, row);
        }
    }

    /// One row of eq. 2.
    #[inline(always)]
    fn correlate<V: Lanes<T>>(&self, weights: &[T], from: &[T], to: &mut [T], row: usize) {
        let n_states = self.layout.n_states;
        let mut first = 0;
        while first < n_states {
            match n_states - first {
                1 => self.group::<V, 1>(weights, from, to, row, first),
                2 => self.group::<V, 2>(weights, from, to, row, first),
                _ => self.group::<V, GROUP>(weights, from, to, row, first),
            }
            first += GROUP;
        }
    }

    /// The same for the next states from `first` on.
    #[inline(always)]
    fn group<V: Lanes<T>, const G: usize>(
        &self,
        weights: &[T],
        from: &[T],
        to: &mut [T],
        row: usize,
        first: usize,
    ) {
        let columns = self.layout.columns();
        let mut col = 0;
        while col + WIDE * LANES <= columns {
            self.block::<V, G, WIDE>(weights, from, to, (row, col), first);
            col += WIDE * LANES;
        }
        while col < columns {
            self.block::<V, G, 1>(weights, from, to, (row, col), first);
            col += LANES;
        }
    }

    /// The same for `B` vectors of cells.
    #[inline(always)]
    fn block<V: Lanes<T>, const G: usize, const B: usize>(
        &self,
        weights: &[T],
        from: &[T],
        to: &mut [T],
        (row, col): (usize, usize),
        first: usize,
    ) {
        let layout = &self.layout;
        let (n_states, n_taps) = (layout.n_states, layout.n_taps());
        let mut sums = [[V::splat(T::zero()); B]; G];
        for state in 0..n_states {
            for a in 0..layout.kernel_height {
                for c in 0..layout.kernel_width {
                    let at = state * layout.plane + (row + a) * layout.stride + c + col;
                    let tap = state * n_taps + a * layout.kernel_width + c;
                    let weight = |g: usize| weights[(first + g) * n_states * n_taps + tap];
                    let taps: [V; G] = from_fn(|g| V::splat(weight(g)));
                    let cells: [V; B] = from_fn(|b| load(from, at + b * LANES));
                    for (&tap, sums) in taps.iter().zip(&mut sums) {
                        for (&cells, sum) in cells.iter().zip(sums) {
                            *sum = tap.multiply_add(cells, *sum);
                        }
                    }
                }
            }
        }
        for (g, sums) in sums.iter().enumerate() {
            let at = (first + g) * layout.plane + layout.row(row) + col;
            for (b, sum) in sums.iter().enumerate() {
                store(*sum, to, at + b * LANES);
            }
        }
    }

    /// One row of eq. 3.
    #[inline(always)]
    fn normalise<V: Lanes<T>>(&self, u: &mut [T], factors: &mut [T], row: usize) {
        let layout = &self.layout;
        for col in (0..layout.columns()).step_by(LANES) {
            let at = layout.row(row) + col;
            let mask: V = load(&self.mask, col);
            // Beside the grid the sum may be 0, where no factor is wanted.
            let mut total = V::splat(T::one()).minus(mask);
            for state in 0..layout.n_states {
                total = total.plus(load(u, state * layout.plane + at));
            }
            let factor = mask.over(total);
            store(factor, factors, at);
            for state in 0..layout.n_states {
                let at = state * layout.plane + at;
                let weights: V = load(u, at);
                store(weights.times(factor), u, at);
            }
        }
    }

    /// The gradients of one row of the kernel between `from` and `G` next states, three taps a time.
    #[inline(always)]
    fn taps<V: Lanes<T>, const G: usize>(
        &self,
        p: &[T],
        h: &[T],
        region: &Region,
        corner: (usize, usize, usize),
        gradient: &mut [f64],
    ) {
        let mut first = 0;
        while first + 3 <= self.layout.kernel_width {
            self.some_taps::<V, G, 3>(p, h, region, corner, first, gradient);
            first += 3;
        }
        while first < self.layout.kernel_width {
            self.some_taps::<V, G, 1>(p, h, region, corner, first, gradient);
            first += 1;
        }
    }

    #[inline(always)]
    fn some_taps<V: Lanes<T>, const G: usize, const C: usize>(
        &self,
        p: &[T],
        h: &[T],
        region: &Region,
        (to, from, kernel_row): (usize, usize, usize),
        first: usize,
        gradient: &mut [f64],
    ) {
        let layout = &self.layout;
        let tap = from * layout.plane + kernel_row * layout.stride + first;
        let origin = layout.row(0);
        let mut sums = [[V::splat(T::zero()); C]; G];
        for row in region.rows.clone() {
            for at in region.places(layout, row) {
                let cells: [V; C] = from_fn(|c| load(p, tap + at - origin + c));
                for (g, sums) in sums.iter_mut().enumerate() {
                    let h: V = load(h, (to + g) * layout.plane + at);
                    for (&cells, sum) in cells.iter().zip(sums) {
                        *sum = cells.multiply_add(h, *sum);
                    }
                }
            }
        }
        for (g, sums) in sums.iter().enumerate() {
            let entry = ((to + g) * layout.n_states + from) * layout.n_taps();
            let entry = entry + kernel_row * layout.kernel_width + first;
            for (gradient, &sum) in gradient[entry..].iter_mut().zip(sums) {
                *gradient += total(sum);
            }
        }
    }
}

/// The rows and vectors of columns outside of which a gradient is zero.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Region {
    pub(super) rows: Range<usize>,
    pub(super) cols: Range<usize>,
}

impl Region {
    pub(super) fn add(&mut self, row: usize, col: usize) {
        self.rows = widened(&self.rows, row..row + 1);
        let col = col / LANES * LANES;
        self.cols = widened(&self.cols, col..col + LANES);
    }

    /// The cells that the kernel reaches from these.
    pub(super) fn reached(&self, layout: &Layout) -> Self {
        if self.rows.is_empty() {
            return Self::default();
        }
        let (above, left) = (layout.above, layout.left);
        let rows = self.rows.start.saturating_sub(above)
            ..(self.rows.end + above).min(layout.shape.height());
        let first = self.cols.start.saturating_sub(left) / LANES * LANES;
        let end = (self.cols.end + left).next_multiple_of(LANES);
        Self {
            rows,
            cols: first..end.min(layout.columns()),
        }
    }

    /// Places of the vectors in a row.
    #[inline(always)]
    fn places(&self, layout: &Layout, row: usize) -> impl Iterator<Item = usize> + use<> {
        let start = layout.row(row);
        self.cols.clone().step_by(LANES).map(move |col| start + col)
    }
}

fn widened(range: &Range<usize>, other: Range<usize>) -> Range<usize> {
    if range.is_empty() {
        return other;
    }
    range.start.min(other.start)..range.end.max(other.end)
}

#[inline(always)]
fn load<T, V: Lanes<T>>(planes: &[T], at: usize) -> V {
    let lanes = planes[at..].first_chunk();
    V::load(lanes.expect("invariant: the layout has room for whole vectors"))
}

#[inline(always)]
fn store<T, V: Lanes<T>>(numbers: V, planes: &mut [T], at: usize) {
    let lanes = planes[at..].first_chunk_mut();
    numbers.store(lanes.expect("invariant: the layout has room for whole vectors"));
}

#[inline(always)]
fn total<T: Real, V: Lanes<T>>(numbers: V) -> f64 {
    let mut lanes = [T::zero(); LANES];
    numbers.store(&mut lanes);
    let lanes = lanes.iter();
    lanes
        .map(|lane| lane.to_f64().expect("invariant: floats cast"))
        .sum()
}
