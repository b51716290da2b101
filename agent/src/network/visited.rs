//! The decoder's last doubling, and the loss behind it, at visited cells only.
//!
//! A path visits some 30 of 4,096 cells, and each depends on 2 x 2 inputs of 16 channels. Here channels
//! are in lanes.

use super::batch_norm::{Norm, Sums};
use super::deconv::Map;
use super::lanes::{Arithmetic, LANES, Lanes};
use super::loss::CellLoss;
use super::window::Visit;
use protocol::frame::UNOBSERVED;

/// The last doubling's weights, channels in lanes.
#[derive(Debug)]
pub(crate) struct LastLayer {
    /// Before doubling.
    input: Map,
    n_states: usize,
    /// `[entry of the kernel][state]`.
    weights: Vec<Lanes>,
    scale: Lanes,
    shift: Lanes,
}

/// One of the up to four inputs that a cell depends on.
#[derive(Clone, Copy)]
struct Neighbour {
    pixel: usize,
    entry: usize,
    /// Normalised, before ReLU.
    y: Lanes,
    u: Lanes,
}

/// The gradient of one pixel before the last doubling, all channels.
#[derive(Debug)]
pub(crate) struct Touched {
    pixel: usize,
    d: Lanes,
}

impl Touched {
    /// Gradients of one frame's kept channels, zero but for what was touched; `length` numbers each.
    #[inline(always)]
    pub(crate) fn spread(touched: &[Self], kept: &[u16], length: usize, dy: &mut [f32]) {
        let dy = &mut dy[..kept.len() * length];
        dy.fill(0.0);
        for Self { pixel, d } in touched {
            for (dy, &channel) in dy.chunks_exact_mut(length).zip(kept) {
                dy[*pixel] += d.0[usize::from(channel) % LANES];
            }
        }
    }
}

/// One frame: its maps before the last doubling, and where gradients go.
pub(crate) struct LastMaps<'a> {
    pub(crate) kept: &'a [u16],
    pub(crate) u: &'a [f32],
    pub(crate) touched: &'a mut Vec<Touched>,
    pub(crate) sums: &'a mut Sums,
    pub(crate) d_weights: &'a mut [Lanes],
}

impl LastLayer {
    /// From PyTorch's `[in][state][4][4]`.
    pub(crate) fn new(input: Map, n_states: usize, weight: &[f32], norm: &Norm) -> Self {
        let mut weights = vec![Lanes::ZERO; 16 * n_states];
        for (index, &entry) in weight.iter().enumerate() {
            let (channel, state, tap) = (index / 16 / n_states, index / 16 % n_states, index % 16);
            weights[tap * n_states + state].0[channel] = entry;
        }
        Self {
            input,
            n_states,
            weights,
            scale: Lanes::load(&norm.scale),
            shift: Lanes::load(&norm.shift),
        }
    }

    /// Room for [`LastMaps::d_weights`].
    pub(crate) fn gradient(n_states: usize) -> Vec<Lanes> {
        vec![Lanes::ZERO; 16 * n_states]
    }

    /// Adds gradients of the weights to PyTorch's layout.
    pub(crate) fn add_gradient(d_weights: &[Lanes], n_states: usize, to: &mut [f32]) {
        for (index, to) in to.iter_mut().enumerate() {
            let (channel, state, tap) = (index / 16 / n_states, index / 16 % n_states, index % 16);
            *to += d_weights[tap * n_states + state].0[channel];
        }
    }

    /// Loss of one frame's visits, with all gradients.
    #[inline(always)]
    pub(crate) fn frame<A: Arithmetic>(
        &self,
        visits: &[Visit],
        maps: &mut LastMaps<'_>,
        loss: &mut CellLoss,
    ) {
        let mut sums = [Lanes::ZERO; 2];
        let mut logits = vec![Lanes::ZERO; self.n_states];
        for visits in visits.chunks(LANES) {
            let mut values = [UNOBSERVED; LANES];
            for (lane, &visit) in visits.iter().enumerate() {
                values[lane] = visit.value;
                self.logits::<A>(visit, maps, lane, &mut logits);
            }
            loss.add::<A>(&mut logits, &values);
            for (lane, &visit) in visits.iter().enumerate() {
                self.backward::<A>(visit, lane, &logits, maps, &mut sums);
            }
        }
        for channel in 0..LANES {
            let [dy, product] = sums.map(|sums| sums.0[channel]);
            maps.sums.add(channel, (dy, product));
        }
    }

    #[inline(always)]
    fn logits<A: Arithmetic>(
        &self,
        visit: Visit,
        maps: &LastMaps<'_>,
        lane: usize,
        logits: &mut [Lanes],
    ) {
        for logits in logits.iter_mut() {
            logits.0[lane] = 0.0;
        }
        self.each_neighbour::<A>(visit, maps.kept, maps.u, |neighbour| {
            let x = Lanes(neighbour.y.0.map(|y| y.max(0.0)));
            for (state, logits) in logits.iter_mut().enumerate() {
                let weights = self.weights[neighbour.entry * self.n_states + state];
                logits.0[lane] += Lanes::ZERO.add_product::<A>(x, weights).sum();
            }
        });
    }

    #[inline(always)]
    fn backward<A: Arithmetic>(
        &self,
        visit: Visit,
        lane: usize,
        d_logits: &[Lanes],
        maps: &mut LastMaps<'_>,
        sums: &mut [Lanes; 2],
    ) {
        let LastMaps {
            kept,
            u,
            touched,
            d_weights,
            ..
        } = maps;
        self.each_neighbour::<A>(visit, kept, u, |neighbour| {
            let first = neighbour.entry * self.n_states;
            let x = Lanes(neighbour.y.0.map(|y| y.max(0.0)));
            let mut d = Lanes::ZERO;
            for (state, d_logits) in d_logits.iter().enumerate() {
                let d_logit = d_logits.0[lane];
                d = d.add_scaled::<A>(d_logit, self.weights[first + state]);
                d_weights[first + state] = d_weights[first + state].add_scaled::<A>(d_logit, x);
            }
            for channel in 0..LANES {
                d.0[channel] = if neighbour.y.0[channel] > 0.0 {
                    d.0[channel]
                } else {
                    0.0
                };
            }
            sums[0] = sums[0].add::<A>(d);
            sums[1] = sums[1].add_product::<A>(d, neighbour.u);
            touched.push(Touched {
                pixel: neighbour.pixel,
                d,
            });
        });
    }

    /// The inputs of one cell, all channels; those that dropout took are zero.
    #[inline(always)]
    fn each_neighbour<A: Arithmetic>(
        &self,
        visit: Visit,
        kept: &[u16],
        u: &[f32],
        mut each: impl FnMut(Neighbour),
    ) {
        let [rows, cols] = self.input.size();
        let length = self.input.length();
        let (row, col) = (usize::from(visit.row), usize::from(visit.col));
        for term in 0..4 {
            // Cell 2 y + p depends on y + p - 1 and y + p, through entries 3 - p and 1 - p.
            let (down, right) = (row / 2 + row % 2 + term / 2, col / 2 + col % 2 + term % 2);
            if !(1..=rows).contains(&down) || !(1..=cols).contains(&right) {
                continue;
            }
            let pixel = self.input.at(down - 1, right - 1);
            let mut values = Lanes::ZERO;
            for (index, &channel) in kept.iter().enumerate() {
                values.0[usize::from(channel) % LANES] = u[index * length + pixel];
            }
            each(Neighbour {
                pixel,
                entry: (3 - row % 2 - term / 2 * 2) * 4 + 3 - col % 2 - term % 2 * 2,
                y: self.shift.add_product::<A>(values, self.scale),
                u: values,
            });
        }
    }
}
