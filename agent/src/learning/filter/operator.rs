//! The operator `Phi_w` (paper eqs. 2 and 3, without bias) for dense kernels, and its derivatives.
//!
//! Forward, `v[m] = sum_n sum_a w[m, n, a] p[n, . + a]` and `u = v / sum_m v`. Backward, from
//! `g = dL/du`: `h = dL/dv = (g - sum_m g[m] u[m]) / sum_m v`; `dL/dw[m, n, a] = sum_cells h[m]
//! p[n, . + a]`; `dL/dp` is the correlation of `h` with the kernel turned and its states exchanged.
//!
//! Where each state `o` that a cell itself can be in has a kernel of its own, whose centre sees `o` itself:
//! `u[m] = sum_o p[o] q[o, m]` with `q[o, m] = v[o, m] / sum_m v[o, m]`. Backward, with `d[o] = sum_m g[m] q[o, m]`:
//! `h[o, m] = p[o] (g[m] - d[o]) / sum_m v[o, m]`, and `dL/dp[o]` has `d[o]` too.

use crate::learning::filter::correlation::{Base, Correlation, Region, load, store};
use crate::learning::filter::layout::Layout;
use crate::learning::filter::vector::{LANES, Lanes, Real};
use std::ops::Range;

/// Weights `w[to, from, row, col]`, or `w[own, to, from, row, col]`, laid out for a grid.
#[derive(Debug, Clone)]
pub(super) struct Operator<T> {
    pub(super) layout: Layout,
    forward: Correlation<T>,
    backward: Correlation<T>,
    /// Where kernels see the cell's own state: the weights of their centres, `[own, to]`.
    centres: Option<Vec<T>>,
    mask: Vec<T>,
}

impl<T: Real> Operator<T> {
    pub(super) fn new(layout: Layout, n_kernels: usize, weights: &[T]) -> Self {
        let mut weights = weights.to_vec();
        let centres = (n_kernels > 1).then(|| {
            let centres = centres(&layout);
            centres
                .map(|(own, all)| {
                    let weight = weights[own];
                    all.for_each(|at| weights[at] = T::zero());
                    weight
                })
                .collect()
        });
        let forward = Correlation::new(layout, layout.n_states, weights);
        Self {
            layout,
            backward: forward.turned(),
            forward,
            centres,
            mask: layout.mask(),
        }
    }

    /// Planes of `v` and `h`.
    pub(super) fn weighed_planes(&self) -> Vec<T> {
        vec![T::zero(); self.forward.n_to() * self.layout.plane]
    }

    /// `u = Phi_w(p)` in planes. Of a kernel of all cells `factors` (one plane) gets `1 / sum_m v`, 0 beside the
    /// grid; of others `v` is room.
    #[inline(always)]
    pub(super) fn forward<V: Lanes<T>>(
        &self,
        p: &[T],
        u: &mut [T],
        factors: &mut [T],
        v: &mut [T],
    ) {
        for row in 0..self.layout.shape.height() {
            match &self.centres {
                None => {
                    self.forward.row::<V>(p, u, Base::Zero, row);
                    self.normalise::<V>(u, factors, row);
                }
                Some(centres) => {
                    self.forward.row::<V>(p, v, Base::Biases(centres), row);
                    self.mix::<V>(p, v, u, row);
                }
            }
        }
    }

    /// `h` from `g` in some rows and columns; `g` becomes `d`, and `u` is no more, where kernels see the cell's own state.
    #[inline(always)]
    pub(super) fn backward_normalise<V: Lanes<T>>(
        &self,
        p: &[T],
        u: &mut [T],
        factors: &[T],
        (g, h): (&mut [T], &mut [T]),
        region: &Region,
    ) {
        for row in region.rows.clone() {
            match &self.centres {
                None => {
                    let places = region.places(&self.layout, row);
                    self.unnormalise::<V>(g, u, factors, h, places);
                }
                Some(centres) => {
                    // Whole rows: h is 0 where g is.
                    self.forward.row::<V>(p, h, Base::Biases(centres), row);
                    self.unmix::<V>(p, u, g, h, row);
                }
            }
        }
    }

    /// Adds `dL/dw` of some rows and columns of `h` to `gradient`; [`Self::end_gradient`] is still to come.
    #[inline(always)]
    pub(super) fn add_weight_gradient<V: Lanes<T>>(
        &self,
        p: &[T],
        h: &[T],
        region: &Region,
        gradient: &mut [f64],
    ) {
        self.forward
            .add_weight_gradient::<V>(p, h, region, gradient);
    }

    /// A centre that sees the cell's own state has the sum of `h` as its derivative. As beliefs sum to one, that is the sum
    /// of what the states that it could see have.
    pub(super) fn end_gradient(&self, gradient: &mut [f64]) {
        if self.centres.is_none() {
            return;
        }
        for (own, all) in centres(&self.layout) {
            let sum: f64 = all.clone().map(|at| gradient[at]).sum();
            all.for_each(|at| gradient[at] = 0.0);
            gradient[own] = sum;
        }
    }

    /// `dL/dp` from `h`, and from `d` in `g`, in some rows.
    #[inline(always)]
    pub(super) fn backward_correlate<V: Lanes<T>>(&self, h: &[T], g: &mut [T], rows: Range<usize>) {
        let base = match self.centres {
            None => Base::Zero,
            Some(_) => Base::Planes,
        };
        for row in rows {
            self.backward.row::<V>(h, g, base, row);
        }
    }

    /// One row of eq. 3.
    #[inline(always)]
    fn normalise<V: Lanes<T>>(&self, u: &mut [T], factors: &mut [T], row: usize) {
        for col in (0..self.layout.columns()).step_by(LANES) {
            let at = self.layout.row(row) + col;
            let factor: V = self.factor(u, 0, at, col);
            store(factor, factors, at);
            for state in 0..self.layout.n_states {
                let at = state * self.layout.plane + at;
                let weights: V = load(u, at);
                store(weights.times(factor), u, at);
            }
        }
    }

    /// The reverse of [`Self::normalise`]: `h`.
    #[inline(always)]
    fn unnormalise<V: Lanes<T>>(
        &self,
        g: &[T],
        u: &[T],
        factors: &[T],
        h: &mut [T],
        places: impl Iterator<Item = usize>,
    ) {
        let Layout {
            n_states, plane, ..
        } = self.layout;
        for at in places {
            let mut mean = V::splat(T::zero());
            for state in 0..n_states {
                let (g, u): (V, V) = (load(g, state * plane + at), load(u, state * plane + at));
                mean = g.multiply_add(u, mean);
            }
            let factor: V = load(factors, at);
            for state in 0..n_states {
                let g: V = load(g, state * plane + at);
                store(g.minus(mean).times(factor), h, state * plane + at);
            }
        }
    }

    /// One row of `u` from `v`, by the cell's own state.
    #[inline(always)]
    fn mix<V: Lanes<T>>(&self, p: &[T], v: &[T], u: &mut [T], row: usize) {
        let Layout {
            n_states, plane, ..
        } = self.layout;
        for col in (0..self.layout.columns()).step_by(LANES) {
            let at = self.layout.row(row) + col;
            for state in 0..n_states {
                store(V::splat(T::zero()), u, state * plane + at);
            }
            for own in 0..n_states {
                let first = own * n_states;
                let p: V = load(p, own * plane + at);
                let share = p.times(self.factor(v, first, at, col));
                for state in 0..n_states {
                    let v: V = load(v, (first + state) * plane + at);
                    let sum: V = load(u, state * plane + at);
                    store(v.multiply_add(share, sum), u, state * plane + at);
                }
            }
        }
    }

    /// The reverse of [`Self::mix`]: `h` in the place of `v`, and `d` in that of `g`.
    #[inline(always)]
    fn unmix<V: Lanes<T>>(&self, p: &[T], d: &mut [T], g: &mut [T], h: &mut [T], row: usize) {
        let Layout {
            n_states, plane, ..
        } = self.layout;
        for col in (0..self.layout.columns()).step_by(LANES) {
            let at = self.layout.row(row) + col;
            for own in 0..n_states {
                let first = own * n_states;
                let factor: V = self.factor(h, first, at, col);
                let mut mean = V::splat(T::zero());
                for state in 0..n_states {
                    let (g, v): (V, V) = (
                        load(g, state * plane + at),
                        load(h, (first + state) * plane + at),
                    );
                    mean = g.multiply_add(v.times(factor), mean);
                }
                store(mean, d, own * plane + at);
                let share = factor.times(load(p, own * plane + at));
                for state in 0..n_states {
                    let g: V = load(g, state * plane + at);
                    store(g.minus(mean).times(share), h, (first + state) * plane + at);
                }
            }
            for state in 0..n_states {
                let d: V = load(d, state * plane + at);
                store(d, g, state * plane + at);
            }
        }
    }

    /// `1 / sum_m v` of the planes from `first` on, 0 beside the grid.
    #[inline(always)]
    fn factor<V: Lanes<T>>(&self, v: &[T], first: usize, at: usize, col: usize) -> V {
        let mask: V = load(&self.mask, col);
        // Beside the grid the sum may be 0, where no factor is wanted.
        let mut total = V::splat(T::one()).minus(mask);
        for state in first..first + self.layout.n_states {
            total = total.plus(load(v, state * self.layout.plane + at));
        }
        mask.over(total)
    }
}

/// For each own state and each next one, the place of the weight of the centre that sees the own state, and of those of
/// all states that it could see.
fn centres(layout: &Layout) -> impl Iterator<Item = (usize, impl Iterator<Item = usize> + Clone)> {
    let (n_states, n_taps) = (layout.n_states, layout.n_taps());
    (0..n_states * n_states).map(move |weighed| {
        let place = move |from| (weighed * n_states + from) * n_taps + n_taps / 2;
        (place(weighed / n_states), (0..n_states).map(place))
    })
}
