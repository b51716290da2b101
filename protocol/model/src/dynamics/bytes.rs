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
//!
//! If kernels depend on the cell's own state, so does the meaning of a byte value. The neighbour at the centre tap is
//! then the cell itself, whose state is known, so `f` at this tap is the next state to which that state gives the most
//! weight. If a cell is certain to keep its state, its byte always decides it.
//!
//! If the model has several zones, the bounds of byte values differ between lanes. There is one table for each pattern
//! of zones that occurs in a chunk of [`LANES`] cells.

use super::super::grid::Shape;
use super::lanes::{
    FastOwn, FastTap, LANES, blend, blend_own, bounds, fast_taps, fill, high_bits, list_lanes,
    transposed,
};
use super::mixture::Mixture;
use super::places::{Places, centre};
use std::collections::HashMap;
use std::ops::Range;

/// The meaning of each byte value: a tap, whose neighbour then decides the cell, or an escape.
#[derive(Debug)]
pub(super) struct Bytes {
    fast: Fast,
    /// The index in `fast` of each chunk's table, if the model has several zones. Otherwise all chunks use the first
    /// table.
    of_chunk: Option<Vec<u32>>,
    /// One bit per home (see `places.rs`), which is set if a cell of the grid has this home.
    on_grid: Vec<u64>,
}

#[derive(Debug)]
enum Fast {
    /// If kernels do not depend on the cell's own state: one table per pattern of zones.
    Alike {
        tables: Vec<Vec<FastTap>>,
        /// `f` as a table over bytes, or `None` if it maps every state to itself.
        likeliest: Option<Box<[u8; 256]>>,
    },
    /// If kernels depend on the cell's own state: one table per own state for each pattern of zones, and the offset of
    /// a cell from its home.
    Own(Vec<Vec<FastOwn>>, usize),
}

impl Bytes {
    /// Makes the tables from the mixtures of each zone: one mixture for all cells, or one per own state. `zones`
    /// contains the zone of each cell, indexed by home. Without mixtures, every byte escapes.
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

    /// Writes the next state of each cell in a band, or a mark if its byte escapes.
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

    /// Lists the homes of the marked cells in a band, and returns the number of these cells.
    #[inline(never)] // If it were inlined, LLVM would run out of registers, and a step would take 10 % longer.
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
                .expect("invariant: the list is LANES longer than a band");
            list_lanes(bits, home as u32, to);
            n_undecided += bits.count_ones() as usize;
        }
        n_undecided
    }
}

/// Returns the distinct patterns of zones in chunks of homes, and the index of each chunk's pattern.
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

/// Returns the taps that byte values stand for, if kernels do not depend on the cell's own state. `mixtures` contains
/// the mixture of each lane.
fn fast_alike(mixtures: &[&Mixture; LANES], offsets: &[usize], is_zoned: bool) -> Vec<FastTap> {
    let taps = offsets.iter().enumerate();
    let taps = taps.map(|(tap, offset)| (mixtures.map(|it| it.counts()[tap]), *offset));
    if is_zoned {
        fast_taps::<true>([0; LANES], taps)
    } else {
        fast_taps::<false>([0; LANES], taps)
    }
}

/// Returns the meaning of byte values in cells whose own state is `own`. `mixtures` contains the mixture of each lane.
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

/// Returns one bit per home (see `places.rs`), which is set if a cell of the grid has this home.
fn on_grid(shape: Shape, stride: usize) -> Vec<u64> {
    let mut bits = vec![0; (shape.height() * stride).div_ceil(LANES)];
    for row in 0..shape.height() {
        for home in row * stride..row * stride + shape.width() {
            bits[home / LANES] |= 1_u64 << transposed((home % LANES) as u32);
        }
    }
    bits
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
