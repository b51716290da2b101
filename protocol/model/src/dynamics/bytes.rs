//! Draws the next state of most cells with one random byte each.
//!
//! Why it is fast: a few comparisons and blends of bytes decide 64 cells at a time.
//!
//! Why the distribution is the same: let `f(n)` be the next state to which a neighbour in state `n` gives the most
//! weight (in the wildfire model, `n` itself). Whatever the neighbours' states, [`super::parents`] draws "tap `t`, and
//! outcome `f(n_t)`" with a probability of at least `p[t] = min_n w[f(n), n, t] / C`. So `floor(256 * p[t])` of the 256
//! values of a byte stand for this draw. The other values, the *escapes*, leave the cell to `parents`, which first
//! draws from the residual distribution. In the wildfire model, 24 of the 256 values escape. `tests/model/dynamics.rs`
//! compares draws with `Phi` for random models and grids.

use super::lanes::{FastTap, LANES, blend, fast_taps, fill};
use super::mixture::Mixture;
use super::places::Places;
use std::ops::Range;

/// The meaning of each byte value: a tap, whose neighbour then decides the cell, or an escape.
#[derive(Debug)]
pub(super) struct Bytes {
    taps: Vec<FastTap>,
    /// `f` as a table over bytes, or `None` if it maps every state to itself.
    likeliest: Option<Box<[u8; 256]>>,
}

impl Bytes {
    /// Makes the tables from a mixture. Without one, every byte escapes.
    pub(super) fn new(mixture: Option<&Mixture>, offsets: &[usize]) -> Self {
        let counts = mixture.map_or(&[][..], Mixture::counts).iter().copied();
        Self {
            taps: fast_taps(counts.zip(offsets.iter().copied())),
            likeliest: mixture.and_then(|it| table_unless_identity(it.likeliest())),
        }
    }

    /// Writes the next state of each cell in a band, or a mark if its byte escapes.
    #[inline(always)]
    pub(super) fn decide(&self, places: &mut Places, band: Range<usize>, key: u64) {
        let bytes = &mut places.next[band.clone()];
        fill(bytes, key, band.start / 8);
        let (chunks, _) = bytes.as_chunks_mut();
        for (home, lanes) in band.step_by(LANES).zip(chunks) {
            blend(lanes, &self.taps, &places.states[home..]);
            if let Some(likeliest) = &self.likeliest {
                *lanes = lanes.map(|state| likeliest[usize::from(state)]);
            }
        }
    }
}

/// Returns `f` as a table over all byte values, which leaves marks unchanged. `None` if `f` maps every state to itself.
fn table_unless_identity(likeliest: &[usize]) -> Option<Box<[u8; 256]>> {
    let mut table: [u8; 256] = std::array::from_fn(|byte| byte as u8);
    let identity = table;
    for (from, &to) in likeliest.iter().enumerate() {
        table[from] = to as u8;
    }
    (table != identity).then(|| Box::new(table))
}
