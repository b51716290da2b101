//! The operator `Phi_w` on land whose zones have kernels of their own, and its derivatives.
//!
//! The formulas are those of [`super::operator`]. Cells of one zone are computed side by side: what their kernels read is
//! gathered into lanes, and what they owe to the cells that they read is added where it came from.

use crate::learning::filter::layout::{LANES, Layout};
use emberwatch_belief::estimation::parameters::n_zones;
use emberwatch_protocol::Grid;

/// A number for each cell of a chunk.
type Lanes = [f32; LANES];

/// Weights `w[zone, to, from, row, col]`, or `w[zone, own, to, from, row, col]`, laid out for a grid.
#[derive(Debug, Clone)]
pub(super) struct ZonedOperator {
    pub(super) layout: Layout,
    /// Kernels of a zone: 1, or one for each state that a cell itself can be in.
    n_own: usize,
    weights: Vec<f32>,
    chunks: Vec<Chunk>,
    /// Where each tap reads, from a cell's place less [`Self::corner`].
    offsets: Vec<usize>,
    corner: usize,
    /// What the kernels of a chunk read, `[from, tap]`, and its derivatives.
    inputs: Vec<Lanes>,
    by_inputs: Vec<Lanes>,
    /// Weights of the next states, or their derivatives.
    weighed: Vec<Lanes>,
    next: Vec<Lanes>,
    /// `dL/du` while `dL/dp` is written.
    by_next: Vec<f32>,
}

/// Up to [`LANES`] cells of one zone.
#[derive(Debug, Clone)]
struct Chunk {
    zone: usize,
    n_cells: usize,
    /// Their places; those missing are the first again.
    places: [usize; LANES],
}

impl ZonedOperator {
    /// The zone of each cell is `zones`, shape `[H, W]`.
    pub(super) fn new(layout: Layout, zones: &Grid<u8>, n_own: usize, weights: &[f32]) -> Self {
        let n_inputs = layout.n_states * layout.n_taps();
        let taps = (0..layout.kernel_height)
            .flat_map(|row| (0..layout.kernel_width).map(move |col| row * layout.stride + col));
        Self {
            layout,
            n_own,
            weights: weights.to_vec(),
            chunks: chunks(&layout, zones),
            offsets: taps.collect(),
            corner: layout.above * layout.stride + layout.left,
            inputs: vec![[0.0; LANES]; n_inputs],
            by_inputs: vec![[0.0; LANES]; n_inputs],
            weighed: vec![[0.0; LANES]; layout.n_states],
            next: vec![[0.0; LANES]; layout.n_states],
            by_next: layout.planes(),
        }
    }

    /// `u = Phi_w(p)` in planes.
    #[inline(always)] // As are its parts, to be compiled for the vectors of this processor.
    pub(super) fn forward(&mut self, p: &[f32], u: &mut [f32]) {
        let n_states = self.layout.n_states;
        for at in 0..self.chunks.len() {
            self.gather(p, at);
            self.next.fill([0.0; LANES]);
            for own in 0..self.n_own {
                let total = self.weigh(at, own);
                let share = self.share(own, &total);
                for state in 0..n_states {
                    let lanes = self.next[state].iter_mut().zip(&self.weighed[state]);
                    lanes
                        .zip(&share)
                        .for_each(|((next, v), share)| *next += v * share);
                }
            }
            let Chunk {
                n_cells, places, ..
            } = &self.chunks[at];
            for (state, next) in self.next.iter().enumerate() {
                for (place, next) in places[..*n_cells].iter().zip(next) {
                    u[state * self.layout.plane + place] = *next;
                }
            }
        }
    }

    /// From `dL/du` in `g` to `dL/dp`; adds `dL/dw` to `gradient`.
    #[inline(always)]
    pub(super) fn backward(&mut self, p: &[f32], g: &mut [f32], gradient: &mut [f64]) {
        self.by_next.copy_from_slice(g);
        g.fill(0.0);
        for at in 0..self.chunks.len() {
            if !self.gather_next(at) {
                continue;
            }
            self.gather(p, at);
            self.by_inputs.fill([0.0; LANES]);
            for own in 0..self.n_own {
                self.unweigh(at, own, gradient);
            }
            let Chunk {
                n_cells, places, ..
            } = &self.chunks[at];
            for (input, by) in self.by_inputs.iter().enumerate() {
                let (from, tap) = (input / self.offsets.len(), input % self.offsets.len());
                let first = from * self.layout.plane + self.offsets[tap];
                for (place, by) in places[..*n_cells].iter().zip(by) {
                    g[first + place - self.corner] += by;
                }
            }
        }
    }

    /// Reads what the kernels of a chunk see.
    #[inline(always)]
    fn gather(&mut self, p: &[f32], at: usize) {
        let places = &self.chunks[at].places;
        for (input, lanes) in self.inputs.iter_mut().enumerate() {
            let (from, tap) = (input / self.offsets.len(), input % self.offsets.len());
            let first = from * self.layout.plane + self.offsets[tap];
            for (lane, place) in lanes.iter_mut().zip(places) {
                *lane = p[first + place - self.corner];
            }
        }
    }

    /// Reads `dL/du` of a chunk; whether any is not 0.
    #[inline(always)]
    fn gather_next(&mut self, at: usize) -> bool {
        let Chunk {
            n_cells, places, ..
        } = &self.chunks[at];
        let mut any = false;
        for (state, lanes) in self.next.iter_mut().enumerate() {
            *lanes = [0.0; LANES];
            for (lane, place) in lanes.iter_mut().zip(places).take(*n_cells) {
                *lane = self.by_next[state * self.layout.plane + place];
                any |= *lane != 0.0;
            }
        }
        any
    }

    /// The weights of the next states, for cells in state `own` or for all, and their sums.
    #[inline(always)]
    fn weigh(&mut self, at: usize, own: usize) -> Lanes {
        let first = self.kernel(at, own);
        let (n_inputs, centre) = (self.inputs.len(), self.offsets.len() / 2);
        let mut total = [0.0; LANES];
        for (to, weighed) in self.weighed.iter_mut().enumerate() {
            let weights = &self.weights[first + to * n_inputs..][..n_inputs];
            *weighed = [0.0; LANES];
            for (input, (weight, lanes)) in weights.iter().zip(&self.inputs).enumerate() {
                if self.n_own > 1 && input % self.offsets.len() == centre {
                    // A cell's centre is the cell itself, whose state is `own`.
                    if input / self.offsets.len() == own {
                        weighed.iter_mut().for_each(|v| *v += weight);
                    }
                    continue;
                }
                weighed
                    .iter_mut()
                    .zip(lanes)
                    .for_each(|(v, x)| *v += weight * x);
            }
            total
                .iter_mut()
                .zip(&*weighed)
                .for_each(|(total, v)| *total += v);
        }
        total
    }

    /// What the weights of cells in state `own` count in their prediction.
    #[inline(always)]
    fn share(&self, own: usize, total: &Lanes) -> Lanes {
        let p = &self.inputs[own * self.offsets.len() + self.offsets.len() / 2];
        let mut share = total.map(|total| 1.0 / total);
        if self.n_own > 1 {
            share.iter_mut().zip(p).for_each(|(share, p)| *share *= p);
        }
        share
    }

    /// The reverse of [`Self::weigh`] and of what follows.
    #[inline(always)]
    fn unweigh(&mut self, at: usize, own: usize, gradient: &mut [f64]) {
        let total = self.weigh(at, own);
        let share = self.share(own, &total);
        let mut mean = [0.0; LANES];
        for (g, v) in self.next.iter().zip(&self.weighed) {
            for lane in 0..LANES {
                mean[lane] += g[lane] * v[lane] / total[lane];
            }
        }
        let (n_inputs, n_taps, centre) = (
            self.inputs.len(),
            self.offsets.len(),
            self.offsets.len() / 2,
        );
        let first = self.kernel(at, own);
        for (to, g) in self.next.iter().enumerate() {
            let mut h = [0.0; LANES];
            for lane in 0..LANES {
                h[lane] = (g[lane] - mean[lane]) * share[lane];
            }
            for input in 0..n_inputs {
                let place = first + to * n_inputs + input;
                if self.n_own > 1 && input % n_taps == centre {
                    if input / n_taps == own {
                        gradient[place] += f64::from(h.iter().sum::<f32>());
                    }
                    continue;
                }
                let (x, by) = (&self.inputs[input], &mut self.by_inputs[input]);
                let weight = self.weights[place];
                let mut sum = 0.0;
                for lane in 0..LANES {
                    sum += h[lane] * x[lane];
                    by[lane] += weight * h[lane];
                }
                gradient[place] += f64::from(sum);
            }
        }
        if self.n_own > 1 {
            let by = &mut self.by_inputs[own * n_taps + centre];
            by.iter_mut().zip(mean).for_each(|(by, mean)| *by += mean);
        }
    }

    /// The first weight of the kernel of a chunk's cells in state `own`, or of all.
    fn kernel(&self, at: usize, own: usize) -> usize {
        (self.chunks[at].zone * self.n_own + own) * self.layout.n_states * self.inputs.len()
    }
}

/// The cells of one zone after the other.
fn chunks(layout: &Layout, zones: &Grid<u8>) -> Vec<Chunk> {
    let mut of_zones = vec![Vec::new(); n_zones(zones)];
    for (cell, &zone) in zones.iter().enumerate() {
        of_zones[usize::from(zone)].push(layout.place(cell));
    }
    let of_zone = |(zone, all): (usize, Vec<usize>)| {
        let chunks = all.chunks(LANES).map(move |cells| {
            let mut places = [cells[0]; LANES];
            places[..cells.len()].copy_from_slice(cells);
            Chunk {
                zone,
                n_cells: cells.len(),
                places,
            }
        });
        chunks.collect::<Vec<_>>()
    };
    of_zones.into_iter().enumerate().flat_map(of_zone).collect()
}
