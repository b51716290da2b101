//! Correlations of planes with dense kernels, and their derivatives with respect to the weights.
//!
//! [`emberwatch_model::Transition`] also computes the forward pass. It is fast for sparse or repeated weights, which
//! learned kernels lack, and it has no gradient.

use crate::layout::{LANES, Layout};
use pulp::{Simd, bytemuck};
use std::ops::Range;

/// Number of planes computed at once. Together with [`WIDE`] vectors of cells per plane, they fill the SIMD registers.
const GROUP: usize = 3;

const WIDE: usize = 4;

/// A convolution from planes to planes: `to[m] = sum_n sum_a w[m, n, a] from[n, . + a]`.
#[derive(Debug, Clone)]
pub(crate) struct Convolution {
    layout: Layout,
    /// The weights `w[to, from, row, col]`.
    weights: Vec<f32>,
}

impl Convolution {
    pub(crate) fn new(layout: Layout, weights: Vec<f32>) -> Self {
        Self { layout, weights }
    }

    /// Returns the convolution that takes derivatives from `to` back to `from`, with the weights
    /// `w[from, to, KH - 1 - row, KW - 1 - col]`.
    pub(crate) fn turned(&self) -> Self {
        let (n, n_taps) = (self.layout.n_states, self.layout.n_taps());
        let mut turned = Vec::with_capacity(self.weights.len());
        for from in 0..n {
            for to in 0..n {
                let straight = &self.weights[(to * n + from) * n_taps..][..n_taps];
                turned.extend(straight.iter().rev());
            }
        }
        Self::new(self.layout, turned)
    }

    #[inline(always)]
    pub(crate) fn row<S: Simd>(&self, simd: S, from: &[f32], to: &mut [f32], row: usize) {
        let n_to = self.layout.n_states;
        for first in (0..n_to).step_by(GROUP) {
            match n_to - first {
                1 => self.group::<S, 1>(simd, from, to, row, first),
                2 => self.group::<S, 2>(simd, from, to, row, first),
                _ => self.group::<S, GROUP>(simd, from, to, row, first),
            }
        }
    }

    #[inline(always)]
    fn group<S: Simd, const G: usize>(
        &self,
        simd: S,
        from: &[f32],
        to: &mut [f32],
        row: usize,
        first: usize,
    ) {
        let columns = self.layout.columns();
        let mut col = 0;
        while col + WIDE * S::F32_LANES <= columns {
            self.block::<S, G, WIDE>(simd, from, to, (row, col), first);
            col += WIDE * S::F32_LANES;
        }
        while col < columns {
            self.block::<S, G, 1>(simd, from, to, (row, col), first);
            col += S::F32_LANES;
        }
    }

    #[inline(always)]
    fn block<S: Simd, const G: usize, const B: usize>(
        &self,
        simd: S,
        from: &[f32],
        to: &mut [f32],
        (row, col): (usize, usize),
        first: usize,
    ) {
        let layout = &self.layout;
        let n_taps = layout.n_taps();
        let corner = first * layout.plane + layout.row(row) + col;
        let place = |g: usize, b: usize| corner + g * layout.plane + b * S::F32_LANES;
        let mut sums = [[simd.splat_f32s(0.0); B]; G];
        for plane in 0..self.layout.n_states {
            for a in 0..layout.kernel_height {
                for c in 0..layout.kernel_width {
                    let at = plane * layout.plane + (row + a) * layout.stride + c + col;
                    let tap = plane * n_taps + a * layout.kernel_width + c;
                    let mut cells = [simd.splat_f32s(0.0); B];
                    for (b, cells) in cells.iter_mut().enumerate() {
                        *cells = load::<S>(from, at + b * S::F32_LANES);
                    }
                    for (g, sums) in sums.iter_mut().enumerate() {
                        let weight =
                            self.weights[(first + g) * self.layout.n_states * n_taps + tap];
                        let weight = simd.splat_f32s(weight);
                        for (&cells, sum) in cells.iter().zip(sums) {
                            *sum = simd.mul_add_e_f32s(weight, cells, *sum);
                        }
                    }
                }
            }
        }
        for (g, sums) in sums.iter().enumerate() {
            for (b, sum) in sums.iter().enumerate() {
                store::<S>(*sum, to, place(g, b));
            }
        }
    }

    /// `h` contains the derivatives with respect to the result, which are zero outside `region`.
    #[inline(always)]
    pub(crate) fn add_weight_gradient<S: Simd>(
        &self,
        simd: S,
        from: &[f32],
        h: &[f32],
        region: &Region,
        gradient: &mut [f64],
    ) {
        let n_to = self.layout.n_states;
        for plane in 0..self.layout.n_states {
            for kernel_row in 0..self.layout.kernel_height {
                for to in (0..n_to).step_by(GROUP) {
                    let corner = [to, plane, kernel_row];
                    match n_to - to {
                        1 => self.taps::<S, 1>(simd, from, h, region, corner, gradient),
                        2 => self.taps::<S, 2>(simd, from, h, region, corner, gradient),
                        _ => self.taps::<S, GROUP>(simd, from, h, region, corner, gradient),
                    }
                }
            }
        }
    }

    #[inline(always)]
    fn taps<S: Simd, const G: usize>(
        &self,
        simd: S,
        p: &[f32],
        h: &[f32],
        region: &Region,
        [to, from, kernel_row]: [usize; 3],
        gradient: &mut [f64],
    ) {
        let mut first = 0;
        while first < self.layout.kernel_width {
            let tap = [to, from, kernel_row, first];
            match self.layout.kernel_width - first {
                1 | 2 => {
                    self.some_taps::<S, G, 1>(simd, p, h, region, tap, gradient);
                    first += 1;
                }
                _ => {
                    self.some_taps::<S, G, 3>(simd, p, h, region, tap, gradient);
                    first += 3;
                }
            }
        }
    }

    #[inline(always)]
    fn some_taps<S: Simd, const G: usize, const C: usize>(
        &self,
        simd: S,
        p: &[f32],
        h: &[f32],
        region: &Region,
        [to, from, kernel_row, first]: [usize; 4],
        gradient: &mut [f64],
    ) {
        let layout = &self.layout;
        let tap = from * layout.plane + kernel_row * layout.stride + first;
        let origin = layout.row(0);
        let mut sums = [[simd.splat_f32s(0.0); C]; G];
        for row in region.rows.clone() {
            for at in region.places::<S>(layout, row) {
                let mut cells = [simd.splat_f32s(0.0); C];
                for (c, cells) in cells.iter_mut().enumerate() {
                    *cells = load::<S>(p, tap + at - origin + c);
                }
                for (g, sums) in sums.iter_mut().enumerate() {
                    let h = load::<S>(h, (to + g) * layout.plane + at);
                    for (&cells, sum) in cells.iter().zip(sums) {
                        *sum = simd.mul_add_e_f32s(cells, h, *sum);
                    }
                }
            }
        }
        for (g, sums) in sums.iter().enumerate() {
            let entry = ((to + g) * self.layout.n_states + from) * layout.n_taps();
            let entry = entry + kernel_row * layout.kernel_width + first;
            for (gradient, &sum) in gradient[entry..].iter_mut().zip(sums) {
                *gradient += total::<S>(sum);
            }
        }
    }
}

/// The rows and columns within which a gradient can be non-zero. The columns form whole SIMD vectors.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Region {
    pub(crate) rows: Range<usize>,
    pub(crate) cols: Range<usize>,
}

impl Region {
    pub(crate) fn add(&mut self, row: usize, col: usize) {
        self.rows = widened(&self.rows, row..row + 1);
        let col = col / LANES * LANES;
        self.cols = widened(&self.cols, col..col + LANES);
    }

    pub(crate) fn reached(&self, layout: &Layout) -> Self {
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

    #[inline(always)]
    pub(crate) fn places<S: Simd>(
        &self,
        layout: &Layout,
        row: usize,
    ) -> impl Iterator<Item = usize> + use<S> {
        let start = layout.row(row);
        let cols = self.cols.clone().step_by(S::F32_LANES);
        cols.map(move |col| start + col)
    }
}

fn widened(range: &Range<usize>, other: Range<usize>) -> Range<usize> {
    if range.is_empty() {
        return other;
    }
    range.start.min(other.start)..range.end.max(other.end)
}

#[inline(always)]
pub(crate) fn load<S: Simd>(planes: &[f32], at: usize) -> S::f32s {
    S::as_simd_f32s(&planes[at..][..S::F32_LANES]).0[0]
}

#[inline(always)]
pub(crate) fn store<S: Simd>(numbers: S::f32s, planes: &mut [f32], at: usize) {
    S::as_mut_simd_f32s(&mut planes[at..][..S::F32_LANES]).0[0] = numbers;
}

#[inline(always)]
fn total<S: Simd>(numbers: S::f32s) -> f64 {
    let lanes: &[f32] = bytemuck::cast_slice(std::slice::from_ref(&numbers));
    lanes.iter().map(|&lane| f64::from(lane)).sum()
}
