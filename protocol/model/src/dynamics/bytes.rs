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
//!
//! Where zones differ, lanes have bounds of their own: a table for each pattern of zones that [`LANES`] cells have.

use super::super::grid::Shape;
use super::lanes::{
    FastOwn, FastTap, LANES, blend, blend_own, bounds, fast_taps, fill, high_bits, list_lanes,
    transposed,
};
use super::mixture::Mixture;
use super::places::{Places, centre};
use std::collections::HashMap;
use std::ops::Range;

/// What byte values stand for.
#[derive(Debug)]
pub(super) struct Bytes {
    fast: Fast,
    /// Which table of `fast` each chunk of homes takes, where zones differ; else the first.
    of_chunk: Option<Vec<u32>>,
    /// A bit for each home: whether it is a cell's.
    on_grid: Vec<u64>,
}

#[derive(Debug)]
enum Fast {
    /// In every cell.
    Alike {
        tables: Vec<Vec<FastTap>>,
        /// `f` as a table over bytes, unless it maps every state to itself.
        likeliest: Option<Box<[u8; 256]>>,
    },
    /// By the cell's own state, with the offset under which it lies.
    Own(Vec<Vec<FastOwn>>, usize),
}

impl Bytes {
    /// Tables of one mixture for all cells, or of one for each own state; as many for each zone, where `zones` has that
    /// of each home. Without any mixture, every byte escapes.
    pub(super) fn new(
        mixtures: &[Mixture],
        offsets: &[usize],
        shape: Shape,
        stride: usize,
        zones: Option<&[u8]>,
    ) -> Self {
        let n_zones = mixtures.first().map_or(1, Mixture::n_zones);
        let n_own = mixtures.len() / n_zones;
        let (patterns, of_chunk) = zones.map_or((vec![[0; LANES]], None), patterns);
        let tables = patterns.iter().map(|zones| {
            let by_lane = |own: usize| zones.map(|zone| &mixtures[usize::from(zone) * n_own + own]);
            (0..n_own).map(by_lane).collect::<Vec<_>>()
        });
        let is_zoned = of_chunk.is_some();
        let fast = match n_own {
            0 => Fast::Alike {
                tables: patterns.iter().map(|_| Vec::new()).collect(),
                likeliest: None,
            },
            1 => Fast::Alike {
                tables: tables
                    .map(|of| fast_alike(&of[0], offsets, is_zoned))
                    .collect(),
                likeliest: table_unless_identity(mixtures[0].likeliest(0)),
            },
            _ => {
                let of_pattern = |of: Vec<[&Mixture; LANES]>| {
                    let states = of.iter().enumerate();
                    let tables = states.map(|(own, of)| fast_own(own, of, offsets, is_zoned));
                    tables.collect()
                };
                Fast::Own(tables.map(of_pattern).collect(), centre(offsets))
            }
        };
        Self {
            fast,
            of_chunk,
            on_grid: on_grid(shape, stride),
        }
    }

    /// Writes next states of a band's cells, and marks of those that escape.
    #[inline(always)]
    pub(super) fn decide(&self, places: &mut Places, band: Range<usize>, key: u64) {
        let bytes = &mut places.next[band.clone()];
        fill(bytes, key, band.start / 8);
        match &self.of_chunk {
            None => self.blend::<false>(places, band, |_| 0),
            Some(of_chunk) => self.blend::<true>(places, band, |chunk| of_chunk[chunk] as usize),
        }
    }

    #[inline(always)]
    fn blend<const DIFFER: bool>(
        &self,
        places: &mut Places,
        band: Range<usize>,
        table: impl Fn(usize) -> usize,
    ) {
        let (chunks, _) = places.next[band.clone()].as_chunks_mut();
        let chunks = band.step_by(LANES).zip(chunks);
        match &self.fast {
            Fast::Alike { tables, likeliest } => {
                for (home, lanes) in chunks {
                    let taps = &tables[table(home / LANES)];
                    blend::<DIFFER>(lanes, taps, &places.states[home..]);
                    if let Some(likeliest) = likeliest {
                        *lanes = lanes.map(|state| likeliest[usize::from(state)]);
                    }
                }
            }
            Fast::Own(tables, centre) => {
                for (home, lanes) in chunks {
                    let table = &tables[table(home / LANES)];
                    blend_own::<DIFFER>(lanes, table, &places.states[home..], *centre);
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

/// The patterns of zones that chunks of homes have, and which of them each has.
fn patterns(zones: &[u8]) -> (Vec<[u8; LANES]>, Option<Vec<u32>>) {
    let mut numbers = HashMap::new();
    let mut patterns = Vec::new();
    let of_chunk = zones.as_chunks::<LANES>().0.iter().map(|pattern| {
        *numbers.entry(*pattern).or_insert_with(|| {
            patterns.push(*pattern);
            patterns.len() as u32 - 1
        })
    });
    let of_chunk = of_chunk.collect();
    (patterns, Some(of_chunk))
}

/// What the bytes stand for in cells whose own state does not matter, by the mixture of each lane.
fn fast_alike(mixtures: &[&Mixture; LANES], offsets: &[usize], is_zoned: bool) -> Vec<FastTap> {
    let taps = offsets.iter().enumerate();
    let taps = taps.map(|(tap, offset)| (mixtures.map(|it| it.counts()[tap]), *offset));
    if is_zoned {
        fast_taps::<true>([0; LANES], taps)
    } else {
        fast_taps::<false>([0; LANES], taps)
    }
}

/// What the bytes stand for in cells of one own state, by the mixture of each lane.
fn fast_own(
    own: usize,
    mixtures: &[&Mixture; LANES],
    offsets: &[usize],
    is_zoned: bool,
) -> FastOwn {
    let centre = offsets.len() / 2;
    let counts = |tap: usize| mixtures.map(|mixture| mixture.counts()[tap]);
    let count = counts(centre);
    let neighbours = (0..offsets.len()).filter(|&tap| tap != centre);
    let taps = neighbours.clone().map(|tap| (counts(tap), offsets[tap]));
    let likeliest = neighbours
        .take(1)
        .flat_map(|tap| mixtures[0].likeliest(tap));
    let changes = likeliest.enumerate().filter(|(from, to)| from != *to);
    let (bound, neighbours) = if is_zoned {
        (bounds::<true>(count), fast_taps::<true>(count, taps))
    } else {
        let bound = count.map(|n| n.max(1));
        (bounds::<false>(bound), fast_taps::<false>(count, taps))
    };
    FastOwn {
        own: own as u8,
        likeliest: mixtures[0].likeliest(centre)[own] as u8,
        bound: count.iter().any(|&n| n > 0).then_some(bound),
        neighbours,
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
