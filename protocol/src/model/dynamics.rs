//! The hidden world's own step: `X_{k+1}` drawn cell by cell from `Phi(one-hot X_k)` (paper eqs. 2-4).
//!
//! A pure function of (model, seed, step): no thread, platform or observer changes a cell.
//!
//! # The algorithm
//! Drawing from `Phi` by its formula sums the kernel for every cell. We draw a *parent* instead: by
//! eq. 2, the weight of state `m` in a cell is a sum over the taps `t` of the kernel,
//! `sum_t w[m, n_t, t]`, where `n_t` is the state of the neighbour under the tap. (The bias `b[m]` of
//! eq. 2 counts as weight of the centre tap, whose neighbour is the cell itself and always there.) So
//!
//! 1. pick tap `t` with probability `most[t] / C`, where `most[t] = max_n sum_m w[m, n, t]` and
//!    `C = sum_t most[t]`;
//! 2. pick outcome `m` with probability `w[m, n_t, t] / most[t]`; what is missing to one rejects, and
//!    so does a neighbour off the grid, whose weight is zero;
//! 3. after a rejection, start again.
//!
//! `m` is then accepted with probability `sum_t w[m, n_t, t] / C`, hence with that of `Phi` given that
//! anything is: exact, and of the same cost whatever the size of the kernel. After `ROUNDS`
//! rejections a cell is drawn by summing the kernel after all, which is the same distribution.
//!
//! # One byte decides most cells
//! Let `f(n)` be the state that state `n` mostly leads to (itself, in the wildfire). Whatever the
//! neighbours, "tap `t`, and outcome `f(n_t)`" has at least the probability
//! `fast[t] = min_n w[f(n), n, t] / C`. Of the 256 values of a random byte, `q[t] = floor(256 *
//! fast[t])` stand for it, which makes the common case a few comparisons and blends of whole rows.
//! The other byte values, the *escapes*, draw tap and outcome from the residual distribution: the
//! one above less `q[t] / 256` of each "tap `t`, outcome `f`". In the wildfire 24 of 256 escape, and a
//! third of those are rejected (`mixture.rs` has the tables).
//!
//! # Kernels that see the cell's own state
//! Each own state has a mixture of its own. Its centre tap has one parent state alone, so that `f` is the
//! likeliest outcome there, and needs not be that of a neighbour in the same state. A cell whose weights
//! depend on no neighbour is never rejected, and one that stays as it is for certain takes its byte alone.
//!
//! # Random numbers
//! Two words of the step's ChaCha8 stream key two SplitMix64 generators, as in the sensor: one gives
//! a byte for every home (see [`Dynamics`]), the other 32 bits for each draw, band by band, round by
//! round. (ChaCha8 throughout took 2.0 of 7.1 us on a 64 x 64 grid.)

use super::file::{MAX_VALUES, ModelError};
use super::grid::{Grid, Shape};
use super::lanes::{
    FastOwn, FastTap, LANES, blend, blend_own, fast_taps, fill, high_bits, list_lanes, transposed,
};
use super::mixture::{Draw, Mixture, REJECTED, invert, uniform};
use super::parameters::Model;
use super::randomness::{Purpose, split_mix, stream};
use super::vectors::vectorised;
use rand::Rng;
use std::iter::zip;
use std::sync::Arc;

/// Rounds of drawing parents before a cell's kernel is summed. The wildfire rejects about 1 in 30,
/// in a corner 1 in 3; only models with columns of very different sums come here often.
const ROUNDS: usize = 8;

/// Cells finished before the next are begun: what a band works on (bytes, parents, lists) stays in a
/// 32 KiB cache. A multiple of [`LANES`].
const BAND: usize = 8192;

/// The world's transition for one model on one grid, with its work space (which no result depends
/// on): give each thread its own clone.
///
/// The work space has a place for every cell and, so that no cell is special, for a margin of half a
/// kernel. A cell's *home* is the place of its upper left tap.
#[derive(Debug, Clone)]
pub struct Dynamics {
    shape: Shape,
    tables: Arc<Tables>,
    stride: usize,
    margins: [usize; 2],
    /// `X_k` with a margin of [`REJECTED`].
    parents: Vec<u8>,
    /// By home: random bytes, then states and marks, then `X_{k+1}`.
    next: Vec<u8>,
    /// A bit for each home: whether it is a cell's.
    on_grid: Vec<u64>,
    /// Homes of the cells to draw (again).
    undecided: Vec<u32>,
    /// Their random numbers.
    randoms: Vec<u8>,
}

/// What follows from the model and the grid's width: the same for every world.
#[derive(Debug)]
struct Tables {
    n_states: usize,
    initial: Vec<f64>,
    /// One, or one for each state that a cell itself can be in.
    mixtures: Vec<Mixture>,
    fast: Fast,
    /// `None`: every cell's kernel is summed.
    draw: Option<Draw>,
    /// Where each tap reads in `parents`, relative to a cell's home.
    offsets: Vec<usize>,
}

/// What the random bytes stand for.
#[derive(Debug)]
enum Fast {
    /// In every cell.
    Alike {
        /// The taps with `q > 0`.
        taps: Vec<FastTap>,
        /// `f` as a table over bytes, unless it maps every state to itself.
        likeliest: Option<Box<[u8; 256]>>,
    },
    /// By the cell's own state.
    Own(Vec<FastOwn>),
}

impl Dynamics {
    /// Makes the tables of a model for a grid.
    ///
    /// # Errors
    /// [`ModelError::ZeroWeight`] where eq. 3 could divide by zero ([`Model::check_on`]).
    pub fn new(model: &Model, shape: Shape) -> Result<Self, ModelError> {
        model.check_on(shape)?;
        let (_, _, kernel_height, kernel_width) = model.kernel().dim();
        let stride = shape.width() + kernel_width - 1;
        let n_homes = (shape.height() * stride).next_multiple_of(LANES);
        let n_places = n_homes + (kernel_height - 1) * stride + kernel_width - 1;
        Ok(Self {
            shape,
            tables: Arc::new(Tables::new(model, stride)),
            stride,
            margins: [kernel_height / 2, kernel_width / 2],
            parents: vec![REJECTED; n_places],
            next: vec![0; n_homes],
            on_grid: on_grid(shape, stride),
            undecided: vec![0; n_homes.min(BAND) + LANES],
            randoms: vec![0; n_homes.min(BAND) * size_of::<u32>()],
        })
    }

    /// The states at step 0 of a world: each cell drawn from the model's initial distribution.
    pub fn initial(&self, seed: u64) -> Grid<u8> {
        let mut rng = stream(seed, Purpose::Initial, 0);
        Grid::from_shape_simple_fn(self.shape.dim(), || {
            invert(&self.tables.initial, uniform(rng.next_u64()))
        })
    }

    /// Moves the states of a world from step `n` to step `n + 1`.
    ///
    /// # Panics
    /// If `states` has another shape, is not row-major, or holds a value that is no state.
    pub fn step(&mut self, seed: u64, n: u64, states: &mut Grid<u8>) {
        assert_eq!(states.dim(), self.shape.dim(), "states: expected [H, W]");
        let cells = states.as_slice_mut().expect("states: expected row-major");
        let keys = keys(seed, n);
        vectorised(
            #[inline(always)]
            || self.advance(keys, cells),
        );
    }

    #[inline(always)] // As are its parts, to be compiled for the vectors of this processor.
    fn advance(&mut self, [byte_key, draw_key]: [u64; 2], cells: &mut [u8]) {
        self.load(cells);
        let mut n_words = 0;
        for first in (0..self.next.len()).step_by(BAND) {
            let end = self.next.len().min(first + BAND);
            fill(&mut self.next[first..end], byte_key, first / 8);
            self.decide_most(first, end);
            let mut n_undecided = self.find_undecided(first, end);
            for _ in 0..self.tables.n_rounds() {
                let randoms = &mut self.randoms[..n_undecided.next_multiple_of(2) * 4];
                fill(randoms, draw_key, n_words);
                n_words += randoms.len() / 8;
                n_undecided = match self.tables.fast {
                    Fast::Alike { .. } => self.draw_parents::<false>(n_undecided),
                    Fast::Own(_) => self.draw_parents::<true>(n_undecided),
                };
                if n_undecided == 0 {
                    break;
                }
            }
            self.sum_kernels(n_undecided, draw_key, n_words);
            n_words += n_undecided;
        }
        self.store(cells);
    }

    /// Copies the states inside the margins.
    #[inline(always)]
    fn load(&mut self, cells: &[u8]) {
        let ([above, left], width) = (self.margins, self.shape.width());
        let largest = cells.iter().fold(0, |most, &state| state.max(most));
        assert!(
            usize::from(largest) < self.tables.n_states,
            "states: expected values below S"
        );
        let rows = self.parents.chunks_exact_mut(self.stride).skip(above);
        for (from, to) in cells.chunks_exact(width).zip(rows) {
            to[left..left + width].copy_from_slice(from);
        }
    }

    /// Turns the random bytes of a band into next states and marks of undecided cells.
    #[inline(always)]
    fn decide_most(&mut self, first: usize, end: usize) {
        let (chunks, _) = self.next[first..end].as_chunks_mut();
        let chunks = (first..).step_by(LANES).zip(chunks);
        match &self.tables.fast {
            Fast::Alike { taps, likeliest } => {
                for (home, lanes) in chunks {
                    blend(lanes, taps, &self.parents[home..]);
                    if let Some(likeliest) = likeliest {
                        *lanes = lanes.map(|parent| likeliest[usize::from(parent)]);
                    }
                }
            }
            Fast::Own(tables) => {
                let centre = self.tables.centre();
                for (home, lanes) in chunks {
                    blend_own(lanes, tables, &self.parents[home..], centre);
                }
            }
        }
    }

    /// Lists the homes of a band that hold a mark and returns how many there are.
    #[inline(never)] // As `draw_parents`.
    fn find_undecided(&mut self, first: usize, end: usize) -> usize {
        let (chunks, _) = self.next[first..end].as_chunks();
        let on_grid = &self.on_grid[first / LANES..];
        let mut n_undecided = 0;
        for ((home, lanes), on_grid) in (first..).step_by(LANES).zip(chunks).zip(on_grid) {
            let bits = high_bits(lanes) & on_grid;
            let to = self.undecided[n_undecided..].first_chunk_mut();
            let to = to.expect("invariant: LANES more than a band has");
            list_lanes(bits, home as u32, to);
            n_undecided += bits.count_ones() as usize;
        }
        n_undecided
    }

    /// One round: draws parent and outcome for every listed cell, and keeps the rejected ones.
    #[inline(never)] // Within its caller LLVM runs out of registers: 10 % more a step.
    fn draw_parents<const OWN: bool>(&mut self, n_undecided: usize) -> usize {
        let centre = self.tables.centre();
        let Some(draw) = &self.tables.draw else {
            return n_undecided;
        };
        let (parents, next) = (&self.parents[..], &mut self.next[..]);
        let undecided = &mut self.undecided[..n_undecided];
        let randoms = &self.randoms.as_chunks().0[..n_undecided];
        let mut n_rejected = 0;
        for index in 0..n_undecided {
            let home = undecided[index];
            let mark = next[home as usize];
            let random = u32::from_le_bytes(randoms[index]);
            let own = if OWN {
                parents[home as usize + centre]
            } else {
                0
            };
            let state = draw.outcome(own, mark, random, parents, home);
            next[home as usize] = state;
            // Branch-free: no rejection is predictable.
            undecided[n_rejected] = home;
            n_rejected += usize::from(state == REJECTED);
        }
        n_rejected
    }

    /// Eqs. 2-4 as they stand, for the cells that every round rejected.
    fn sum_kernels(&mut self, n_undecided: usize, key: u64, n_words: usize) {
        let tables = &self.tables;
        for (index, &home) in self.undecided[..n_undecided].iter().enumerate() {
            let mut sums = [0.0; MAX_VALUES];
            let mixture = match tables.fast {
                Fast::Alike { .. } => &tables.mixtures[0],
                Fast::Own(_) => {
                    let own = self.parents[home as usize + tables.centre()];
                    &tables.mixtures[usize::from(own)]
                }
            };
            for (tap, offset) in tables.offsets.iter().enumerate() {
                let parent = self.parents[home as usize + offset];
                if parent != REJECTED {
                    let weights = mixture.weights(tap, usize::from(parent));
                    sums.iter_mut().zip(weights).for_each(|(sum, w)| *sum += w);
                }
            }
            let random = split_mix(key, (n_words + index) as u64);
            self.next[home as usize] = invert(&sums[..tables.n_states], uniform(random));
        }
    }

    /// Copies the next states out of the work space.
    #[inline(always)]
    fn store(&self, cells: &mut [u8]) {
        let width = self.shape.width();
        let rows = self.next.chunks(self.stride);
        for (to, from) in cells.chunks_exact_mut(width).zip(rows) {
            to.copy_from_slice(&from[..width]);
        }
    }
}

impl Tables {
    fn new(model: &Model, stride: usize) -> Self {
        let (n_states, _, kernel_height, kernel_width) = model.kernel().dim();
        let taps = (0..kernel_height).flat_map(|a| (0..kernel_width).map(move |c| (a, c)));
        let offsets: Vec<usize> = taps.map(|(a, c)| a * stride + c).collect();
        let mixtures = Mixture::of_model(model);
        let draw = Draw::new(&mixtures, &offsets);
        // Summed kernels follow the whole distribution: no byte may stand for part of it.
        let by_bytes = if draw.is_some() { &mixtures[..] } else { &[] };
        let fast = if model.sees_own_state() {
            let states = by_bytes.iter().enumerate();
            Fast::Own(states.map(|(own, m)| fast_own(own, m, &offsets)).collect())
        } else {
            let taps = |m: &Mixture| fast_taps(0, zip(m.counts().to_vec(), offsets.clone()));
            Fast::Alike {
                taps: by_bytes.iter().flat_map(taps).collect(),
                likeliest: table_unless_identity(mixtures[0].likeliest(0)),
            }
        };
        Self {
            n_states,
            initial: model.initial().to_vec(),
            fast,
            mixtures,
            draw,
            offsets,
        }
    }

    /// Where the cell itself lies, relative to its home.
    fn centre(&self) -> usize {
        self.offsets[self.offsets.len() / 2]
    }

    fn n_rounds(&self) -> usize {
        if self.draw.is_some() { ROUNDS } else { 0 }
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

/// What keys the bytes and the draws of a step.
fn keys(seed: u64, n: u64) -> [u64; 2] {
    let mut rng = stream(seed, Purpose::Transition, n);
    [rng.next_u64(), rng.next_u64()]
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wider_vectors_change_no_cell() {
        let shape = Shape::new(40, 70).expect("test shape");
        for name in ["wildfire", "wildfire-burnout"] {
            let model = Model::built_in(name).expect(name);
            let mut dynamics = Dynamics::new(&model, shape).expect(name);
            let mut states = dynamics.initial(3);
            for n in 0..300 {
                let mut portable = states.clone();
                let cells = portable.as_slice_mut().expect("row-major");
                dynamics.advance(keys(3, n), cells);
                dynamics.step(3, n, &mut states);
                assert_eq!(states, portable);
            }
            assert!(
                states.iter().any(|&state| state == 2),
                "{name}: no such state"
            );
        }
    }
}
