//! The operator `Phi_w` (paper eqs. 2 and 3, without bias) for dense kernels, and its derivatives.
//!
//! Forward: `v[m] = sum_n sum_a w[m, n, a] p[n, . + a]` and `u = v / sum_m v`.
//! Backward, from `g = dL/du`: `h = dL/dv = (g - sum_m g[m] u[m]) / sum_m v`, and
//! `dL/dw[m, n, a] = sum_cells h[m] p[n, . + a]`. `dL/dp` is the correlation of `h` with the kernel, rotated by 180
//! degrees and with its two state axes exchanged.

use crate::convolution::{Convolution, Region, load, store};
use crate::layout::Layout;
use pulp::Simd;
use std::ops::Range;

/// The operator for a grid. Weights are `w[to, from, row, col]`.
#[derive(Debug, Clone)]
pub(crate) struct Operator {
    pub(crate) layout: Layout,
    forward: Convolution,
    backward: Convolution,
    mask: Vec<f32>,
}

impl Operator {
    pub(crate) fn new(layout: Layout, weights: &[f32]) -> Self {
        let forward = Convolution::new(layout, weights.to_vec());
        Self {
            layout,
            backward: forward.turned(),
            forward,
            mask: layout.mask(),
        }
    }

    /// Computes `u = Phi_w(p)`. `factors` (one plane) receives `1 / sum_m v`, which is 0 outside of the grid.
    #[inline(always)]
    pub(crate) fn forward<S: Simd>(&self, simd: S, p: &[f32], u: &mut [f32], factors: &mut [f32]) {
        for row in 0..self.layout.shape.height() {
            self.forward.row(simd, p, u, row);
            self.normalise(simd, u, factors, row);
        }
    }

    #[inline(always)]
    pub(crate) fn backward_normalise<S: Simd>(
        &self,
        simd: S,
        u: &[f32],
        factors: &[f32],
        (g, h): (&[f32], &mut [f32]),
        region: &Region,
    ) {
        for row in region.rows.clone() {
            for at in region.places::<S>(&self.layout, row) {
                self.unnormalise(simd, g, u, factors, h, at);
            }
        }
    }

    #[inline(always)]
    pub(crate) fn add_weight_gradient<S: Simd>(
        &self,
        simd: S,
        p: &[f32],
        h: &[f32],
        region: &Region,
        gradient: &mut [f64],
    ) {
        self.forward
            .add_weight_gradient(simd, p, h, region, gradient);
    }

    #[inline(always)]
    pub(crate) fn backward_correlate<S: Simd>(
        &self,
        simd: S,
        h: &[f32],
        g: &mut [f32],
        rows: Range<usize>,
    ) {
        for row in rows {
            self.backward.row(simd, h, g, row);
        }
    }

    /// Applies eq. 3 to one row.
    #[inline(always)]
    fn normalise<S: Simd>(&self, simd: S, u: &mut [f32], factors: &mut [f32], row: usize) {
        for col in (0..self.layout.columns()).step_by(S::F32_LANES) {
            let at = self.layout.row(row) + col;
            let factor = self.factor(simd, u, at, col);
            store::<S>(factor, factors, at);
            for state in 0..self.layout.n_states {
                let at = state * self.layout.plane + at;
                store::<S>(simd.mul_f32s(load::<S>(u, at), factor), u, at);
            }
        }
    }

    #[inline(always)]
    fn unnormalise<S: Simd>(
        &self,
        simd: S,
        g: &[f32],
        u: &[f32],
        factors: &[f32],
        h: &mut [f32],
        at: usize,
    ) {
        let places = (0..self.layout.n_states).map(|state| state * self.layout.plane + at);
        let mut mean = simd.splat_f32s(0.0);
        for at in places.clone() {
            mean = simd.mul_add_e_f32s(load::<S>(g, at), load::<S>(u, at), mean);
        }
        let factor = load::<S>(factors, at);
        for at in places {
            let over_mean = simd.sub_f32s(load::<S>(g, at), mean);
            store::<S>(simd.mul_f32s(over_mean, factor), h, at);
        }
    }

    #[inline(always)]
    fn factor<S: Simd>(&self, simd: S, v: &[f32], at: usize, col: usize) -> S::f32s {
        let mask = load::<S>(&self.mask, col);
        // Outside of the grid, the sum may be 0. Adding 1 there avoids a division by zero.
        let mut total = simd.sub_f32s(simd.splat_f32s(1.0), mask);
        for state in 0..self.layout.n_states {
            total = simd.add_f32s(total, load::<S>(v, state * self.layout.plane + at));
        }
        simd.div_f32s(mask, total)
    }
}
