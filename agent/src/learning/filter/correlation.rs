//! Correlations of planes with dense kernels, and their derivatives by the weights.
//!
//! [`protocol::Transition`] computes the forward part too; it gains from weights that are zero or
//! alike, of which a learned kernel has none, and does not know derivatives.

use crate::learning::filter::layout::Layout;
use crate::learning::filter::vector::{LANES, Lanes, Real};
use std::ops::Range;

/// Planes computed at once: with [`WIDE`] vectors of cells they fill the registers.
const GROUP: usize = 3;

/// Vectors of cells computed at once.
const WIDE: usize = 4;

/// `to[m] = base[m] + sum_n sum_a w[m, n, a] from[n, . + a]`.
#[derive(Debug, Clone)]
pub(super) struct Correlation<T> {
    layout: Layout,
    n_from: usize,
    /// `w[to, from, row, col]`.
    weights: Vec<T>,
}

/// What the products are added to.
#[derive(Debug, Clone, Copy)]
pub(super) enum Base<'a, T> {
    Zero,
    /// A number for each plane.
    Biases(&'a [T]),
    /// What the planes hold.
    Planes,
}

impl<T: Real> Correlation<T> {
    pub(super) fn new(layout: Layout, n_from: usize, weights: Vec<T>) -> Self {
        Self {
            layout,
            n_from,
            weights,
        }
    }

    pub(super) fn n_to(&self) -> usize {
        self.weights.len() / (self.n_from * self.layout.n_taps())
    }

    /// That of derivatives, from `to` to `from`: `w[from, to, KH - 1 - row, KW - 1 - col]`.
    pub(super) fn turned(&self) -> Self {
        let (n_from, n_taps) = (self.n_from, self.layout.n_taps());
        let mut turned = Vec::with_capacity(self.weights.len());
        for from in 0..n_from {
            for to in 0..self.n_to() {
                let straight = &self.weights[(to * n_from + from) * n_taps..][..n_taps];
                turned.extend(straight.iter().rev());
            }
        }
        Self::new(self.layout, self.n_to(), turned)
    }

    /// One row of the grid.
    #[inline(always)]
    pub(super) fn row<V: Lanes<T>>(&self, from: &[T], to: &mut [T], base: Base<'_, T>, row: usize) {
        let n_to = self.n_to();
        let mut first = 0;
        while first < n_to {
            match n_to - first {
                1 => self.group::<V, 1>(from, to, base, row, first),
                2 => self.group::<V, 2>(from, to, base, row, first),
                _ => self.group::<V, GROUP>(from, to, base, row, first),
            }
            first += GROUP;
        }
    }

    /// The same for the planes from `first` on.
    #[inline(always)]
    fn group<V: Lanes<T>, const G: usize>(
        &self,
        from: &[T],
        to: &mut [T],
        base: Base<'_, T>,
        row: usize,
        first: usize,
    ) {
        let columns = self.layout.columns();
        let mut col = 0;
        while col + WIDE * LANES <= columns {
            self.block::<V, G, WIDE>(from, to, base, (row, col), first);
            col += WIDE * LANES;
        }
        while col < columns {
            self.block::<V, G, 1>(from, to, base, (row, col), first);
            col += LANES;
        }
    }

    /// The same for `B` vectors of cells.
    #[inline(always)]
    fn block<V: Lanes<T>, const G: usize, const B: usize>(
        &self,
        from: &[T],
        to: &mut [T],
        base: Base<'_, T>,
        (row, col): (usize, usize),
        first: usize,
    ) {
        let layout = &self.layout;
        let n_taps = layout.n_taps();
        let place =
            |g: usize, b: usize| (first + g) * layout.plane + layout.row(row) + col + b * LANES;
        let mut sums = [[V::splat(T::zero()); B]; G];
        for (g, sums) in sums.iter_mut().enumerate() {
            for (b, sum) in sums.iter_mut().enumerate() {
                match base {
                    Base::Zero => {}
                    Base::Biases(biases) => *sum = V::splat(biases[first + g]),
                    Base::Planes => *sum = load(to, place(g, b)),
                }
            }
        }
        for plane in 0..self.n_from {
            for a in 0..layout.kernel_height {
                for c in 0..layout.kernel_width {
                    let at = plane * layout.plane + (row + a) * layout.stride + c + col;
                    let tap = plane * n_taps + a * layout.kernel_width + c;
                    let mut cells = [V::splat(T::zero()); B];
                    for (b, cells) in cells.iter_mut().enumerate() {
                        *cells = load(from, at + b * LANES);
                    }
                    for (g, sums) in sums.iter_mut().enumerate() {
                        let weight = self.weights[(first + g) * self.n_from * n_taps + tap];
                        for (&cells, sum) in cells.iter().zip(sums) {
                            *sum = V::splat(weight).multiply_add(cells, *sum);
                        }
                    }
                }
            }
        }
        for (g, sums) in sums.iter().enumerate() {
            for (b, sum) in sums.iter().enumerate() {
                store(*sum, to, place(g, b));
            }
        }
    }

    /// Adds the derivatives by the weights, of derivatives `h` by some rows and columns of the result.
    #[inline(always)]
    pub(super) fn add_weight_gradient<V: Lanes<T>>(
        &self,
        from: &[T],
        h: &[T],
        region: &Region,
        gradient: &mut [f64],
    ) {
        let n_to = self.n_to();
        for plane in 0..self.n_from {
            for kernel_row in 0..self.layout.kernel_height {
                let mut to = 0;
                while to < n_to {
                    let corner = (to, plane, kernel_row);
                    match n_to - to {
                        1 => self.taps::<V, 1>(from, h, region, corner, gradient),
                        2 => self.taps::<V, 2>(from, h, region, corner, gradient),
                        _ => self.taps::<V, GROUP>(from, h, region, corner, gradient),
                    }
                    to += GROUP;
                }
            }
        }
    }

    /// The gradients of one row of the kernel from a plane to `G` planes, three taps a time.
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
                let mut cells = [V::splat(T::zero()); C];
                for (c, cells) in cells.iter_mut().enumerate() {
                    *cells = load(p, tap + at - origin + c);
                }
                for (g, sums) in sums.iter_mut().enumerate() {
                    let h: V = load(h, (to + g) * layout.plane + at);
                    for (&cells, sum) in cells.iter().zip(sums) {
                        *sum = cells.multiply_add(h, *sum);
                    }
                }
            }
        }
        for (g, sums) in sums.iter().enumerate() {
            let entry = ((to + g) * self.n_from + from) * layout.n_taps();
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
    pub(super) fn places(
        &self,
        layout: &Layout,
        row: usize,
    ) -> impl Iterator<Item = usize> + use<> {
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
pub(super) fn load<T, V: Lanes<T>>(planes: &[T], at: usize) -> V {
    let lanes = planes[at..].first_chunk();
    V::load(lanes.expect("invariant: the layout has room for whole vectors"))
}

#[inline(always)]
pub(super) fn store<T, V: Lanes<T>>(numbers: V, planes: &mut [T], at: usize) {
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
