//! One random byte decides most cells.
//!
//! Why it is fast: whole rows of cells take a few comparisons and blends of bytes, 64 at a time.
//!
//! Why it is the same: let `f(n)` be the state that neighbour state `n` mostly leads to (itself, in the wildfire).
//! Whatever the neighbours, [`super::parents`] draws "tap `t`, and outcome `f(n_t)`" with at least the probability
//! `p[t] = min_n w[f(n), n, t] / C`. Of the 256 values of a byte, `floor(256 * p[t])` stand for it. The other values,
//! the *escapes*, are left to the residual distribution, from which `parents` draws first. In the wildfire 24 of 256
//! escape. `tests/model/dynamics.rs` compares draws with `Phi` for any models and grids.
//!
//! Where kernels see the cell's own state, each own state has byte values of its own: the centre tap has one state
//! alone, so that `f` there is the likeliest outcome, and a cell that stays as it is for certain takes its byte alone.

use super::super::grid::Shape;
use super::lanes::{
    FastOwn, FastTap, LANES, blend, blend_own, fast_taps, fill, high_bits, list_lanes, transposed,
};
use super::mixture::Mixture;
use super::places::{Places, centre};
use std::iter::zip;
use std::ops::Range;

/// What byte values stand for.
#[derive(Debug)]
pub(super) struct Bytes {
    fast: Fast,
    /// A bit for each home: whether it is a cell's.
    on_grid: Vec<u64>,
}

#[derive(Debug)]
enum Fast {
    /// In every cell.
    Alike {
        taps: Vec<FastTap>,
        /// `f` as a table over bytes, unless it maps every state to itself.
        likeliest: Option<Box<[u8; 256]>>,
    },
    /// By the cell's own state, with the offset under which it lies.
    Own(Vec<FastOwn>, usize),
}

impl Bytes {
    /// Tables of one mixture for all cells, or of one for each own state; without any, every byte escapes.
    pub(super) fn new(
        mixtures: &[Mixture],
        offsets: &[usize],
        shape: Shape,
        stride: usize,
    ) -> Self {
        let fast = match mixtures {
            [] => Fast::Alike {
                taps: Vec::new(),
                likeliest: None,
            },
            [mixture] => Fast::Alike {
                taps: fast_taps(0, zip(mixture.counts().to_vec(), offsets.to_vec())),
                likeliest: table_unless_identity(mixture.likeliest(0)),
            },
            by_own_state => {
                let states = by_own_state.iter().enumerate();
                let tables = states.map(|(own, mixture)| fast_own(own, mixture, offsets));
                Fast::Own(tables.collect(), centre(offsets))
            }
        };
        let on_grid = on_grid(shape, stride);
        Self { fast, on_grid }
    }

    /// Writes next states of a band's cells, and marks of those that escape.
    #[inline(always)]
    pub(super) fn decide(&self, places: &mut Places, band: Range<usize>, key: u64) {
        let bytes = &mut places.next[band.clone()];
        fill(bytes, key, band.start / 8);
        let (chunks, _) = bytes.as_chunks_mut();
        let chunks = band.step_by(LANES).zip(chunks);
        match &self.fast {
            Fast::Alike { taps, likeliest } => {
                for (home, lanes) in chunks {
                    blend(lanes, taps, &places.states[home..]);
                    if let Some(likeliest) = likeliest {
                        *lanes = lanes.map(|state| likeliest[usize::from(state)]);
                    }
                }
            }
            Fast::Own(tables, centre) => {
                for (home, lanes) in chunks {
                    blend_own(lanes, tables, &places.states[home..], *centre);
                }
            }
        }
    }

    /// Lists the homes of a band that hold a mark and returns how many there are.
    #[inline(never)] // Within its caller LLVM runs out of registers: 10 % more a step.
    pub(super) fn list_undecided(
        &self,
        places: &Places,
        band: Range<usize>,
        undecided: &mut [u32],
    ) -> usize {
        let (chunks, _) = places.next[band.clone()].as_chunks();
        let on_grid = &self.on_grid[band.start / LANES..];
        let mut n_undecided = 0;
        for ((home, lanes), on_grid) in band.step_by(LANES).zip(chunks).zip(on_grid) {
            let bits = high_bits(lanes) & on_grid;
            let to = undecided[n_undecided..]
                .first_chunk_mut()
                .expect("invariant: LANES more than a band has");
            list_lanes(bits, home as u32, to);
            n_undecided += bits.count_ones() as usize;
        }
        n_undecided
    }
}

/// What the bytes stand for in cells of one own state.
fn fast_own(own: usize, mixture: &Mixture, offsets: &[usize]) -> FastOwn {
    let centre = offsets.len() / 2;
    let count = mixture.counts()[centre];
    let neighbours = (0..offsets.len()).filter(|&tap| tap != centre);
    let taps = neighbours
        .clone()
        .map(|tap| (mixture.counts()[tap], offsets[tap]));
    let likeliest = neighbours.take(1).flat_map(|tap| mixture.likeliest(tap));
    let changes = likeliest.enumerate().filter(|(from, to)| from != *to);
    FastOwn {
        own: own as u8,
        likeliest: mixture.likeliest(centre)[own] as u8,
        count,
        neighbours: fast_taps(count, taps),
        changes: changes.map(|(from, &to)| (from as u8, to as u8)).collect(),
    }
}

/// Which homes are a cell's, a bit each.
fn on_grid(shape: Shape, stride: usize) -> Vec<u64> {
    let mut bits = vec![0; (shape.height() * stride).div_ceil(LANES)];
    for row in 0..shape.height() {
        for home in row * stride..row * stride + shape.width() {
            bits[home / LANES] |= 1_u64 << transposed((home % LANES) as u32);
        }
    }
    bits
}

/// `f` over all bytes, marks unchanged.
fn table_unless_identity(likeliest: &[usize]) -> Option<Box<[u8; 256]>> {
    let mut table: [u8; 256] = std::array::from_fn(|byte| byte as u8);
    let identity = table;
    for (from, &to) in likeliest.iter().enumerate() {
        table[from] = to as u8;
    }
    (table != identity).then(|| Box::new(table))
}
