//! The operator `Phi_w` on land whose zones have kernels of their own, and its derivatives.
//!
//! The formulas are those of [`super::operator`]. Cells of one zone are computed side by side, in lanes: what their kernels
//! read is gathered, and what they owe to the cells that they read is added where it came from.

use crate::filter::layout::{LANES, Layout};
use crate::filter::operator::{end_gradient, take_centres};
use emberwatch_belief::estimation::parameters::n_zones;
use emberwatch_model::Grid;
use std::ops::Range;

/// Rows and columns of the parts of a grid whose cells come one after the other: many chunks owe nothing then.
const TILE: usize = 8;

/// A number for each cell of a chunk.
type Lanes = [f32; LANES];

/// Weights `w[zone, to, from, row, col]`, or `w[zone, own, to, from, row, col]`, laid out for a grid.
#[derive(Debug, Clone)]
pub(super) struct ZonedOperator {
    pub(super) layout: Layout,
    /// Kernels of a zone: 1, or one for each state that a cell itself can be in.
    n_own: usize,
    /// Those of centres that see the cell's own state are 0 here.
    weights: Vec<f32>,
    /// What stands for these: the weights of the centres, `[zone, own, to]`; else zeros.
    biases: Vec<f32>,
    /// Up to [`LANES`] cells of one zone each, zone by zone.
    chunks: Vec<Chunk>,
    of_zones: Vec<Range<usize>>,
    /// Where the kernels read, from a cell's home on: `[from, row, col]`.
    offsets: Vec<usize>,
    /// From a cell's home, which is under the upper left of its kernel, to the cell.
    corner: usize,
    work: Work,
}

/// Homes of cells; missing ones repeat the first.
#[derive(Debug, Clone)]
struct Chunk {
    n_cells: usize,
    homes: [usize; LANES],
}

/// Work space of one chunk, and of one zone.
#[derive(Debug, Clone)]
struct Work {
    /// What the kernels read, `[from, row, col]`.
    inputs: Vec<Lanes>,
    by_inputs: Vec<Lanes>,
    /// Weights of the next states, then their derivatives.
    weighed: Vec<Lanes>,
    /// Next states, or the derivatives by them.
    next: Vec<Lanes>,
    /// Derivatives by the weights of a zone, in the order of these.
    by_weights: Vec<Lanes>,
    /// `dL/du` while `dL/dp` is written.
    by_next: Vec<f32>,
}

impl ZonedOperator {
    /// The zone of each cell is `zones`, shape `[H, W]`.
    pub(super) fn new(layout: Layout, zones: &Grid<u8>, n_own: usize, weights: &[f32]) -> Self {
        let taps = (0..layout.kernel_height)
            .flat_map(|row| (0..layout.kernel_width).map(move |col| row * layout.stride + col));
        let plane = |from| taps.clone().map(move |tap| from * layout.plane + tap);
        let (chunks, of_zones) = chunks(&layout, zones);
        let n_of_zone = n_own * layout.n_states * layout.n_states * layout.n_taps();
        let mut operator = Self {
            layout,
            n_own,
            weights: Vec::new(),
            biases: vec![0.0; of_zones.len() * n_own * layout.n_states],
            chunks,
            of_zones,
            offsets: (0..layout.n_states).flat_map(plane).collect(),
            corner: layout.row(0),
            work: Work::new(&layout, n_of_zone),
        };
        operator.set(weights);
        operator
    }

    /// Takes other weights.
    pub(super) fn set(&mut self, weights: &[f32]) {
        self.weights = weights.to_vec();
        if self.n_own > 1 {
            let of_zones = self.weights.chunks_exact_mut(self.work.by_weights.len());
            let biases = of_zones.flat_map(|weights| take_centres(&self.layout, weights));
            self.biases = biases.collect();
        }
    }

    /// `u = Phi_w(p)` in planes.
    #[inline(always)] // As are its parts, to be compiled for the vectors of this processor.
    pub(super) fn forward(&mut self, p: &[f32], u: &mut [f32]) {
        for zone in 0..self.of_zones.len() {
            for at in self.of_zones[zone].clone() {
                self.gather(p, at);
                self.work.next.fill([0.0; LANES]);
                for own in 0..self.n_own {
                    let share = self.weigh(zone, own).1;
                    for (next, v) in self.work.next.iter_mut().zip(&self.work.weighed) {
                        for lane in 0..LANES {
                            next[lane] += v[lane] * share[lane];
                        }
                    }
                }
                let chunk = &self.chunks[at];
                for (state, next) in self.work.next.iter().enumerate() {
                    let first = state * self.layout.plane + self.corner;
                    for (home, next) in chunk.homes[..chunk.n_cells].iter().zip(next) {
                        u[first + home] = *next;
                    }
                }
            }
        }
    }

    /// From `dL/du` in `g` to `dL/dp`; adds `dL/dw` to `gradient`.
    #[inline(always)]
    pub(super) fn backward(&mut self, p: &[f32], g: &mut [f32], gradient: &mut [f64]) {
        self.work.by_next.copy_from_slice(g);
        g.fill(0.0);
        let n_of_zone = self.work.by_weights.len();
        for zone in 0..self.of_zones.len() {
            self.work.by_weights.fill([0.0; LANES]);
            for at in self.of_zones[zone].clone() {
                if !self.gather_next(at) {
                    continue;
                }
                self.gather(p, at);
                self.work.by_inputs.fill([0.0; LANES]);
                for own in 0..self.n_own {
                    self.unweigh(zone, own);
                }
                let chunk = &self.chunks[at];
                for (offset, by) in self.offsets.iter().zip(&self.work.by_inputs) {
                    for (home, by) in chunk.homes[..chunk.n_cells].iter().zip(by) {
                        g[home + offset] += by;
                    }
                }
            }
            let gradient = &mut gradient[zone * n_of_zone..][..n_of_zone];
            for (sum, by) in gradient.iter_mut().zip(&self.work.by_weights) {
                *sum += by.iter().map(|&lane| f64::from(lane)).sum::<f64>();
            }
        }
    }

    /// The last step of a gradient, as [`super::operator::Operator::end_gradient`].
    pub(super) fn end_gradient(&self, gradient: &mut [f64]) {
        if self.n_own > 1 {
            let of_zones = gradient.chunks_exact_mut(self.work.by_weights.len());
            of_zones.for_each(|gradient| end_gradient(&self.layout, gradient));
        }
    }

    /// Reads what the kernels of a chunk see.
    #[inline(always)]
    fn gather(&mut self, p: &[f32], at: usize) {
        let homes = &self.chunks[at].homes;
        for (offset, lanes) in self.offsets.iter().zip(&mut self.work.inputs) {
            for (lane, home) in lanes.iter_mut().zip(homes) {
                *lane = p[home + offset];
            }
        }
    }

    /// Reads `dL/du` of a chunk; whether any is not 0.
    #[inline(always)]
    fn gather_next(&mut self, at: usize) -> bool {
        let chunk = &self.chunks[at];
        let mut any = false;
        for (state, lanes) in self.work.next.iter_mut().enumerate() {
            *lanes = [0.0; LANES];
            let first = state * self.layout.plane + self.corner;
            for (lane, home) in lanes.iter_mut().zip(&chunk.homes).take(chunk.n_cells) {
                *lane = self.work.by_next[first + home];
                any |= *lane != 0.0;
            }
        }
        any
    }

    /// The weights of the next states, for cells in state `own` or for all; one over their sums, and what they count in the
    /// prediction.
    #[inline(always)]
    fn weigh(&mut self, zone: usize, own: usize) -> (Lanes, Lanes) {
        let ((weights, biases), centre) = (self.kernel(zone, own), self.centre(own));
        let Work {
            inputs, weighed, ..
        } = &mut self.work;
        let rows = self.weights[weights].chunks_exact(inputs.len());
        let rows = rows.zip(&self.biases[biases]);
        let mut total = [0.0; LANES];
        for ((weights, bias), weighed) in rows.zip(weighed) {
            let mut sum = [*bias; LANES];
            for (weight, x) in weights.iter().zip(&*inputs) {
                for lane in 0..LANES {
                    sum[lane] += weight * x[lane];
                }
            }
            for lane in 0..LANES {
                total[lane] += sum[lane];
            }
            *weighed = sum;
        }
        let factor = total.map(|total| 1.0 / total);
        let mut share = factor;
        if self.n_own > 1 {
            let p = &inputs[centre];
            share.iter_mut().zip(p).for_each(|(share, p)| *share *= p);
        }
        (factor, share)
    }

    /// The reverse of [`Self::weigh`] and of what follows.
    #[inline(always)]
    fn unweigh(&mut self, zone: usize, own: usize) {
        let (factor, share) = self.weigh(zone, own);
        let (weights, centre) = (self.kernel(zone, own).0, self.centre(own));
        let Work {
            inputs,
            by_inputs,
            weighed,
            next,
            by_weights,
            ..
        } = &mut self.work;
        let mut mean = [0.0; LANES];
        for (g, v) in next.iter().zip(&*weighed) {
            for lane in 0..LANES {
                mean[lane] += g[lane] * v[lane] * factor[lane];
            }
        }
        for (g, h) in next.iter().zip(&mut *weighed) {
            for lane in 0..LANES {
                h[lane] = (g[lane] - mean[lane]) * share[lane];
            }
        }
        let n_inputs = inputs.len();
        let first = weights.start % by_weights.len();
        let (by_weights, weights) = (
            &mut by_weights[first..][..weights.len()],
            &self.weights[weights],
        );
        for (input, (x, by)) in inputs.iter().zip(by_inputs.iter_mut()).enumerate() {
            let (x, mut sum) = (*x, *by);
            let places = (input..weights.len()).step_by(n_inputs);
            for (h, at) in weighed.iter().zip(places) {
                let (weight, h) = (weights[at], *h);
                let mut by_weight = by_weights[at];
                for lane in 0..LANES {
                    sum[lane] += weight * h[lane];
                    by_weight[lane] += h[lane] * x[lane];
                }
                by_weights[at] = by_weight;
            }
            *by = sum;
        }
        if self.n_own > 1 {
            let by = &mut by_inputs[centre];
            by.iter_mut().zip(mean).for_each(|(by, mean)| *by += mean);
        }
    }

    /// Places of weights and biases of a zone's kernel, of cells in state `own` or of all.
    fn kernel(&self, zone: usize, own: usize) -> (Range<usize>, Range<usize>) {
        let (kernel, n_states) = (zone * self.n_own + own, self.layout.n_states);
        let n_weights = n_states * self.offsets.len();
        let weights = kernel * n_weights..(kernel + 1) * n_weights;
        (weights, kernel * n_states..(kernel + 1) * n_states)
    }

    /// The input that is the cell's own probability of a state.
    fn centre(&self, state: usize) -> usize {
        let n_taps = self.layout.n_taps();
        state * n_taps + n_taps / 2
    }
}

impl Work {
    fn new(layout: &Layout, n_of_zone: usize) -> Self {
        let lanes = |n| vec![[0.0; LANES]; n];
        Self {
            inputs: lanes(layout.n_states * layout.n_taps()),
            by_inputs: lanes(layout.n_states * layout.n_taps()),
            weighed: lanes(layout.n_states),
            next: lanes(layout.n_states),
            by_weights: lanes(n_of_zone),
            by_next: layout.planes(),
        }
    }
}

/// The cells of one zone after the other, those of a chunk near each other, and which chunks each zone has.
fn chunks(layout: &Layout, zones: &Grid<u8>) -> (Vec<Chunk>, Vec<Range<usize>>) {
    let mut cells: Vec<(usize, usize)> = zones.indexed_iter().map(|(cell, _)| cell).collect();
    cells.sort_by_key(|(row, col)| (row / TILE, col / TILE));
    let mut homes = vec![Vec::new(); n_zones(zones)];
    for (row, col) in cells {
        homes[usize::from(zones[(row, col)])].push(row * layout.stride + col);
    }
    let mut chunks = Vec::new();
    let of_zone = |homes: Vec<usize>| {
        let first = chunks.len();
        chunks.extend(homes.chunks(LANES).map(|cells| {
            let mut homes = [cells[0]; LANES];
            homes[..cells.len()].copy_from_slice(cells);
            Chunk {
                n_cells: cells.len(),
                homes,
            }
        }));
        first..chunks.len()
    };
    let of_zones = homes.into_iter().map(of_zone).collect();
    (chunks, of_zones)
}
