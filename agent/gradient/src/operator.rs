//! The operator `Phi_w` (paper eqs. 2 and 3, without bias) for dense kernels, and its derivatives.
//!
//! Forward: `v[m] = sum_n sum_a w[m, n, a] p[n, . + a]` and `u = v / sum_m v`.
//! Backward, from `g = dL/du`: `h = dL/dv = (g - sum_m g[m] u[m]) / sum_m v`, and
//! `dL/dw[m, n, a] = sum_cells h[m] p[n, . + a]`. `dL/dp` is the correlation of `h` with the kernel, rotated by 180
//! degrees and with its two state axes exchanged.
//!
//! With own-state kernels, there is one kernel for each state `o` of the cell itself, whose centre weight applies to
//! `o` only. Forward: `u[m] = sum_o p[o] q[o, m]` with `q[o, m] = v[o, m] / sum_m v[o, m]`. Backward, with
//! `d[o] = sum_m g[m] q[o, m]`: `h[o, m] = p[o] (g[m] - d[o]) / sum_m v[o, m]`, and `dL/dp[o]` has the additional term
//! `d[o]`.

use crate::convolution::{Base, Convolution, Region, load, store};
use crate::layout::Layout;
use pulp::Simd;
use std::ops::Range;

/// The operator for a grid. Weights are `w[to, from, row, col]`, or `w[own, to, from, row, col]` with own-state
/// kernels.
#[derive(Debug, Clone)]
pub(crate) struct Operator {
    pub(crate) layout: Layout,
    forward: Convolution,
    backward: Convolution,
    /// The centre weights of own-state kernels, `[own, to]`.
    centres: Option<Vec<f32>>,
    mask: Vec<f32>,
}

impl Operator {
    pub(crate) fn new(layout: Layout, n_own: usize, weights: &[f32]) -> Self {
        let mut weights = weights.to_vec();
        let centres = (n_own > 1).then(|| take_centres(&layout, &mut weights));
        let forward = Convolution::new(layout, layout.n_states, weights);
        Self {
            layout,
            backward: forward.turned(),
            forward,
            centres,
            mask: layout.mask(),
        }
    }

    /// Allocates planes for `v` and `h`.
    pub(crate) fn weighed_planes(&self) -> Vec<f32> {
        vec![0.0; self.forward.n_to() * self.layout.plane]
    }

    /// Computes `u = Phi_w(p)`. Without own-state kernels, `factors` (one plane) receives `1 / sum_m v`, which is 0
    /// outside of the grid. With own-state kernels, `v` is a scratch buffer.
    #[inline(always)]
    pub(crate) fn forward<S: Simd>(
        &self,
        simd: S,
        p: &[f32],
        u: &mut [f32],
        factors: &mut [f32],
        v: &mut [f32],
    ) {
        for row in 0..self.layout.shape.height() {
            match &self.centres {
                None => {
                    self.forward.row(simd, p, u, Base::Zero, row);
                    self.normalise(simd, u, factors, row);
                }
                Some(centres) => {
                    self.forward.row(simd, p, v, Base::Biases(centres), row);
                    self.mix(simd, p, v, u, row);
                }
            }
        }
    }

    /// Computes `h` from `g` in a region. With own-state kernels, it replaces `g` with `d` and overwrites `u`.
    #[inline(always)]
    pub(crate) fn backward_normalise<S: Simd>(
        &self,
        simd: S,
        p: &[f32],
        u: &mut [f32],
        factors: &[f32],
        (g, h): (&mut [f32], &mut [f32]),
        region: &Region,
    ) {
        for row in region.rows.clone() {
            match &self.centres {
                None => {
                    for at in region.places::<S>(&self.layout, row) {
                        self.unnormalise(simd, g, u, factors, h, at);
                    }
                }
                Some(centres) => {
                    // Whole rows can be computed, because h is 0 where g is 0.
                    self.forward.row(simd, p, h, Base::Biases(centres), row);
                    self.unmix(simd, p, u, g, h, row);
                }
            }
        }
    }

    /// Adds `dL/dw` for a region of `h` to `gradient`. Call [`Self::end_gradient`] after the last region.
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

    /// Completes the gradient of own-state kernels. The derivative with respect to a centre weight is the sum of `h`
    /// over all cells. As beliefs sum to one, this equals the sum of the derivatives with respect to the centre weights
    /// of all states.
    pub(crate) fn end_gradient(&self, gradient: &mut [f64]) {
        if self.centres.is_some() {
            end_gradient(&self.layout, gradient);
        }
    }

    /// Computes `dL/dp` in some rows, from `h` and, with own-state kernels, from `d` in `g`.
    #[inline(always)]
    pub(crate) fn backward_correlate<S: Simd>(
        &self,
        simd: S,
        h: &[f32],
        g: &mut [f32],
        rows: Range<usize>,
    ) {
        let base = match self.centres {
            None => Base::Zero,
            Some(_) => Base::Planes,
        };
        for row in rows {
            self.backward.row(simd, h, g, base, row);
        }
    }

    /// Applies eq. 3 to one row.
    #[inline(always)]
    fn normalise<S: Simd>(&self, simd: S, u: &mut [f32], factors: &mut [f32], row: usize) {
        for col in (0..self.layout.columns()).step_by(S::F32_LANES) {
            let at = self.layout.row(row) + col;
            let factor = self.factor(simd, u, 0, at, col);
            store::<S>(factor, factors, at);
            for state in 0..self.layout.n_states {
                let at = state * self.layout.plane + at;
                store::<S>(simd.mul_f32s(load::<S>(u, at), factor), u, at);
            }
        }
    }

    /// Computes `h` for one vector of cells, by backpropagation through [`Self::normalise`].
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

    /// Computes one row of `u` from `v` with own-state kernels.
    #[inline(always)]
    fn mix<S: Simd>(&self, simd: S, p: &[f32], v: &[f32], u: &mut [f32], row: usize) {
        let Layout {
            n_states, plane, ..
        } = self.layout;
        for col in (0..self.layout.columns()).step_by(S::F32_LANES) {
            let at = self.layout.row(row) + col;
            for state in 0..n_states {
                store::<S>(simd.splat_f32s(0.0), u, state * plane + at);
            }
            for own in 0..n_states {
                let first = own * n_states;
                let p = load::<S>(p, own * plane + at);
                let share = simd.mul_f32s(p, self.factor(simd, v, first, at, col));
                for state in 0..n_states {
                    let v = load::<S>(v, (first + state) * plane + at);
                    let sum = load::<S>(u, state * plane + at);
                    let sum = simd.mul_add_e_f32s(v, share, sum);
                    store::<S>(sum, u, state * plane + at);
                }
            }
        }
    }

    /// Backpropagates through [`Self::mix`] in one row: replaces `v` (in `h`) with `h`, and `g` with `d`.
    #[inline(always)]
    fn unmix<S: Simd>(
        &self,
        simd: S,
        p: &[f32],
        d: &mut [f32],
        g: &mut [f32],
        h: &mut [f32],
        row: usize,
    ) {
        let Layout {
            n_states, plane, ..
        } = self.layout;
        for col in (0..self.layout.columns()).step_by(S::F32_LANES) {
            let at = self.layout.row(row) + col;
            for own in 0..n_states {
                let first = own * n_states;
                let factor = self.factor(simd, h, first, at, col);
                let mut mean = simd.splat_f32s(0.0);
                for state in 0..n_states {
                    let g = load::<S>(g, state * plane + at);
                    let v = load::<S>(h, (first + state) * plane + at);
                    mean = simd.mul_add_e_f32s(g, simd.mul_f32s(v, factor), mean);
                }
                store::<S>(mean, d, own * plane + at);
                let share = simd.mul_f32s(factor, load::<S>(p, own * plane + at));
                for state in 0..n_states {
                    let over_mean = simd.sub_f32s(load::<S>(g, state * plane + at), mean);
                    let h_at = (first + state) * plane + at;
                    store::<S>(simd.mul_f32s(over_mean, share), h, h_at);
                }
            }
            for state in 0..n_states {
                store::<S>(load::<S>(d, state * plane + at), g, state * plane + at);
            }
        }
    }

    /// Returns `1 / sum_m v` for the planes from `first` on, or 0 outside of the grid.
    #[inline(always)]
    fn factor<S: Simd>(&self, simd: S, v: &[f32], first: usize, at: usize, col: usize) -> S::f32s {
        let mask = load::<S>(&self.mask, col);
        // Outside of the grid, the sum may be 0. Adding 1 there avoids a division by zero.
        let mut total = simd.sub_f32s(simd.splat_f32s(1.0), mask);
        for state in first..first + self.layout.n_states {
            total = simd.add_f32s(total, load::<S>(v, state * self.layout.plane + at));
        }
        simd.div_f32s(mask, total)
    }
}

/// For each own state and next state, returns the index of the centre weight that applies to the own state, and the
/// indices of the centre weights for all states.
fn centres(layout: &Layout) -> impl Iterator<Item = (usize, Vec<usize>)> {
    let (n_states, n_taps) = (layout.n_states, layout.n_taps());
    (0..n_states * n_states).map(move |weighed| {
        let place = |from| (weighed * n_states + from) * n_taps + n_taps / 2;
        (
            place(weighed / n_states),
            (0..n_states).map(place).collect(),
        )
    })
}

/// Extracts the centre weights of own-state kernels, `[own, to]`, and sets all centre weights of the kernels to zero.
fn take_centres(layout: &Layout, weights: &mut [f32]) -> Vec<f32> {
    let take = |(own, all): (usize, Vec<usize>)| {
        let weight = weights[own];
        all.into_iter().for_each(|at| weights[at] = 0.0);
        weight
    };
    centres(layout).map(take).collect()
}

/// Adds the gradients of all centre weights to the own state's weight, see [`Operator::end_gradient`].
fn end_gradient(layout: &Layout, gradient: &mut [f64]) {
    for (own, all) in centres(layout) {
        let sum: f64 = all.iter().map(|&at| gradient[at]).sum();
        all.into_iter().for_each(|at| gradient[at] = 0.0);
        gradient[own] = sum;
    }
}
