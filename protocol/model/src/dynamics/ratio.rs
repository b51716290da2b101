//! Draws next states by the paper's rule (eqs. 2 to 4).
//!
//! # What is drawn
//! A *tap* is a position in the kernel, and so an offset from a cell to a neighbour. A neighbour's weights are its
//! *vote*: with the neighbour at tap `t` in state `n_t`, the weight of next state `m` is `b[m] + sum_t w[m, n_t, t]`
//! (eq. 2). The cell changes to `m` with a probability proportional to this weight (eqs. 3 and 4). `Tables::weights`
//! and `Tables::sum_kernel` compute exactly this.
//!
//! # How it is fast
//! Two faster methods, which draw from the same distribution, are tried first. `bytes.rs` decides most cells of a row
//! with one random byte each. For each remaining cell, `parents.rs` then draws one neighbour and this neighbour's vote,
//! up to eight times. Only cells that are still undecided need the full sum. The wildfire model has hardly any such
//! cells. A model with too many weights for tables needs the full sum for every cell.

use super::super::file::MAX_VALUES;
use super::super::parameters::Ratio;
use super::buffers::{Buffers, Keys};
use super::bytes::Bytes;
use super::kernel::{Kernel, invert, uniform};
use super::lanes::Words;
use super::mixture::Mixture;
use super::parents::Parents;
use super::places::{OFF_GRID, Places};

/// The tables computed from the parameters and the grid, which all worlds share.
#[derive(Debug)]
pub(super) struct Tables {
    kernel: Kernel,
    /// For each tap, the offset of the neighbour from the cell's home (see `places.rs`).
    offsets: Vec<usize>,
    bytes: Bytes,
    /// `None` if the model has too many weights for tables. Then every cell needs the full sum of eq. 2.
    parents: Option<Parents>,
}

impl Tables {
    pub(super) fn new(ratio: &Ratio, places: &Places) -> Self {
        let kernel = Kernel::new(ratio);
        let (_, _, height, width) = ratio.kernel().dim();
        let taps = (0..height * width).map(|tap| (tap / width, tap % width));
        let offsets: Vec<usize> = taps.map(|(row, col)| places.home(row, col)).collect();
        let mixture = Mixture::new(&kernel);
        let parents = Parents::new(&mixture, &offsets);
        // Without `parents`, bytes must not decide any cell, because the full sum draws from the whole distribution
        // instead of the residual one.
        let by_bytes = parents.is_some().then_some(&mixture);
        Self {
            bytes: Bytes::new(by_bytes, &offsets),
            parents,
            kernel,
            offsets,
        }
    }

    #[inline(always)] // Like the functions it calls, so that all are compiled for this processor's vectors.
    pub(super) fn advance(&self, [byte_key, draw_key]: Keys, buffers: &mut Buffers) {
        let mut words = Words::new(draw_key);
        for band in buffers.bands() {
            self.bytes
                .decide(&mut buffers.places, band.clone(), byte_key);
            let mut n_undecided = buffers.list_marked(band);
            let Buffers {
                places,
                listed,
                randoms,
                ..
            } = &mut *buffers;
            if let Some(parents) = &self.parents {
                let undecided = &mut listed[..n_undecided];
                n_undecided = parents.decide(places, undecided, randoms, &mut words);
            }
            self.sum_kernel(&listed[..n_undecided], places, &mut words);
        }
    }

    fn sum_kernel(&self, undecided: &[u32], places: &mut Places, words: &mut Words) {
        for &home in undecided {
            let home = home as usize;
            let weights = self.weights(&places.states[home..]);
            let weights = &weights[..self.kernel.n_states];
            places.next[home] = invert(weights, uniform(words.draw()));
        }
    }

    /// Computes eq. 2: the weight of each next state of a cell. `states` is the part of the buffer that begins at the
    /// cell's home.
    fn weights(&self, states: &[u8]) -> [f64; MAX_VALUES] {
        let mut sums = [0.0; MAX_VALUES];
        for (tap, &offset) in self.offsets.iter().enumerate() {
            let neighbour = states[offset];
            if neighbour != OFF_GRID {
                let weights = self.kernel.weights(tap, usize::from(neighbour));
                sums.iter_mut().zip(weights).for_each(|(sum, w)| *sum += w);
            }
        }
        sums
    }
}
