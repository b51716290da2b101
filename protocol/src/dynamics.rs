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
//! anything is: exact, and of the same cost whatever the size of the kernel. After [`ROUNDS`]
//! rejections a cell is drawn by summing the kernel after all, which is the same distribution.
//!
//! # One byte decides most cells
//! Let `f(n)` be the state that state `n` mostly leads to (itself, in the wildfire). Whatever the
//! neighbours, "tap `t`, and outcome `f(n_t)`" has at least the probability
//! `fast[t] = min_n w[f(n), n, t] / C`. Of the 256 values of a random byte, `q[t] = floor(256 *
//! fast[t])` stand for it, which makes the common case a few comparisons and blends of whole rows.
//! The other byte values, the *escapes*, draw tap and outcome from the residual distribution: the
//! one above less `q[t] / 256` of each "tap `t`, outcome `f`". In the wildfire 24 of 256 escape.
//!
//! Draws of tap and outcome take one `u64`: the low half picks the tap from an alias table (Walker
//! 1977, Vose 1991), the high half the outcome from a table of thresholds. Tables are made in `f64`
//! in a fixed order and rounded to `2^-32`, so they are the same on every platform.
//!
//! The stream of a step gives first a byte for every cell, then round by round a `u64` for every
//! undecided cell in row-major order.

use crate::grid::{Grid, Shape};
use crate::mixture::{Draw, Mixture, REJECTED, invert, uniform};
use crate::model::{MAX_VALUES, Model, ModelError};
use crate::randomness::{Purpose, stream};
use rand::Rng;

/// Mark of a cell that the first byte left to the residual distribution. High bit set, as in
/// [`REJECTED`] and in no state.
const ESCAPED: u8 = 254;

/// Rounds of drawing parents before a cell's kernel is summed. The wildfire rejects about 1 in 30,
/// in a corner 1 in 3; only models with columns of very different sums come here often.
const ROUNDS: usize = 8;

/// Cells decided at once by the first byte: eight SSE registers hold their bytes and states.
const LANES: usize = 64;

/// The world's transition for one model on one grid, with its work space (which no result depends
/// on): give each thread its own clone.
#[derive(Debug, Clone)]
pub struct Dynamics {
    shape: Shape,
    n_states: usize,
    initial: Vec<f64>,
    mixture: Mixture,
    /// The taps with `q > 0`.
    fast: Vec<FastTap>,
    /// `f` as a table over bytes, unless it maps every state to itself.
    likeliest: Option<[u8; 256]>,
    residual_and_full: [Draw; 2],
    /// Where each tap reads in `parents`, relative to a cell's home.
    offsets: Vec<usize>,
    stride: usize,
    margins: [usize; 2],
    /// `X_k` with a margin of [`REJECTED`].
    parents: Vec<u8>,
    undecided: Vec<Undecided>,
}

/// The byte values that stand for one tap.
#[derive(Debug, Clone)]
struct FastTap {
    offset: usize,
    /// The last of them (the first follows on the tap before), in every lane.
    last: [u8; LANES],
}

/// A cell to draw (again).
#[derive(Debug, Clone, Copy)]
struct Undecided {
    cell: u32,
    /// Its place in `parents`, at the upper left tap.
    home: u32,
}

impl Dynamics {
    /// Makes the tables of a model for a grid.
    ///
    /// # Errors
    /// [`ModelError::ZeroWeight`] where eq. 3 could divide by zero ([`Model::check_on`]).
    pub fn new(model: &Model, shape: Shape) -> Result<Self, ModelError> {
        model.check_on(shape)?;
        let (n_states, _, kernel_height, kernel_width) = model.kernel().dim();
        let stride = shape.width() + kernel_width - 1;
        let n_places = (shape.height() + kernel_height - 1) * stride + LANES;
        let taps = (0..kernel_height).flat_map(|a| (0..kernel_width).map(move |c| (a, c)));
        let offsets: Vec<usize> = taps.map(|(a, c)| a * stride + c).collect();
        let mixture = Mixture::new(model);
        let likeliest = mixture.likeliest();
        let counts = mixture.fast_counts(&likeliest);
        let residual = Draw::new(&mixture, &offsets, &likeliest, &counts);
        let full = Draw::new(&mixture, &offsets, &likeliest, &vec![0; offsets.len()]);
        Ok(Self {
            shape,
            n_states,
            initial: model.initial().to_vec(),
            fast: fast_taps(&counts, &offsets),
            likeliest: table_unless_identity(&likeliest),
            mixture,
            residual_and_full: [residual, full],
            offsets,
            stride,
            margins: [kernel_height / 2, kernel_width / 2],
            parents: vec![REJECTED; n_places],
            undecided: Vec::new(),
        })
    }

    /// The states at step 0 of a world: each cell drawn from the model's initial distribution.
    pub fn initial(&self, seed: u64) -> Grid<u8> {
        let mut rng = stream(seed, Purpose::Initial, 0);
        Grid::from_shape_simple_fn(self.shape.dim(), || {
            invert(&self.initial, uniform(rng.next_u64()))
        })
    }

    /// Moves the states of a world from step `n` to step `n + 1`.
    ///
    /// # Panics
    /// If `states` has another shape, is not row-major, or holds a value that is no state.
    pub fn step(&mut self, seed: u64, n: u64, states: &mut Grid<u8>) {
        assert_eq!(states.dim(), self.shape.dim(), "states: expected [H, W]");
        let cells = states.as_slice_mut().expect("states: expected row-major");
        self.load(cells);
        let mut rng = stream(seed, Purpose::Transition, n);
        rng.fill_bytes(cells);
        self.decide_most(cells);
        for _ in 0..ROUNDS {
            if self.undecided.is_empty() {
                return;
            }
            self.draw_parents(cells, &mut rng);
        }
        self.sum_kernels(cells, &mut rng);
    }

    /// Copies the states inside the margins.
    fn load(&mut self, cells: &[u8]) {
        let ([above, left], width) = (self.margins, self.shape.width());
        let largest = cells.iter().fold(0, |most, &state| state.max(most));
        assert!(
            usize::from(largest) < self.n_states,
            "states: expected values below S"
        );
        let rows = self.parents.chunks_exact_mut(self.stride).skip(above);
        for (from, to) in cells.chunks_exact(width).zip(rows) {
            to[left..left + width].copy_from_slice(from);
        }
    }

    /// Turns a random byte in every cell into its next state, or into a mark of an undecided cell.
    fn decide_most(&mut self, cells: &mut [u8]) {
        self.undecided.clear();
        let width = self.shape.width();
        for (row, cells) in cells.chunks_exact_mut(width).enumerate() {
            for (chunk, cells) in cells.chunks_mut(LANES).enumerate() {
                let col = chunk * LANES;
                let home = row * self.stride + col;
                let mut lanes = [0; LANES];
                copy_lanes(cells, &mut lanes);
                let mut lanes = blend(&lanes, &self.fast, &self.parents[home..]);
                if let Some(likeliest) = &self.likeliest {
                    lanes = lanes.map(|parent| likeliest[usize::from(parent)]);
                }
                copy_lanes(&lanes, cells);
                let on_grid = u64::MAX >> (LANES - cells.len());
                let first = (row * width + col) as u32;
                for_each_bit(high_bits(&lanes) & on_grid, |lane| {
                    self.undecided.push(Undecided {
                        cell: first + lane,
                        home: home as u32 + lane,
                    });
                });
            }
        }
    }

    /// One round: draws tap and outcome for every undecided cell, and keeps the rejected ones.
    fn draw_parents(&mut self, cells: &mut [u8], rng: &mut impl Rng) {
        let (parents, undecided) = (&self.parents[..], &mut self.undecided[..]);
        let [residual, full] = &self.residual_and_full;
        let mut n_rejected = 0;
        for index in 0..undecided.len() {
            let at = undecided[index];
            let state = &mut cells[at.cell as usize];
            let draw = if *state == REJECTED { full } else { residual };
            let random = rng.next_u64();
            let tap = draw.tap(random as u32);
            let parent = parents[(at.home + tap.offset) as usize];
            *state = draw.outcome(tap, parent, (random >> 32) as u32);
            undecided[n_rejected] = at;
            n_rejected += usize::from(*state == REJECTED);
        }
        self.undecided.truncate(n_rejected);
    }

    /// Eqs. 2-4 as they stand, for the cells that every round rejected.
    fn sum_kernels(&self, cells: &mut [u8], rng: &mut impl Rng) {
        for &Undecided { cell, home } in &self.undecided {
            let mut sums = [0.0; MAX_VALUES];
            for (tap, offset) in self.offsets.iter().enumerate() {
                let parent = self.parents[home as usize + offset];
                if parent != REJECTED {
                    let weights = self.mixture.weights(tap, usize::from(parent));
                    sums.iter_mut().zip(weights).for_each(|(sum, w)| *sum += w);
                }
            }
            cells[cell as usize] = invert(&sums[..self.n_states], uniform(rng.next_u64()));
        }
    }
}

/// The taps that bytes stand for, with the last byte value of each.
fn fast_taps(counts: &[usize], offsets: &[usize]) -> Vec<FastTap> {
    let mut end = 0;
    let mut taps = Vec::new();
    for (&count, &offset) in counts.iter().zip(offsets) {
        end += count;
        if count > 0 {
            let last = u8::try_from(end - 1).expect("invariant: fast probabilities sum to <= 1");
            taps.push(FastTap {
                offset,
                last: [last; LANES],
            });
        }
    }
    taps
}

/// `f` over all bytes, marks unchanged.
fn table_unless_identity(likeliest: &[usize]) -> Option<[u8; 256]> {
    let mut table: [u8; 256] = std::array::from_fn(|byte| byte as u8);
    let identity = table;
    for (from, &to) in likeliest.iter().enumerate() {
        table[from] = to as u8;
    }
    (table != identity).then_some(table)
}

/// Each lane's parent under the tap that its byte stands for, or [`ESCAPED`].
#[inline(never)] // LLVM vectorises it on its own, not within its caller.
fn blend(bytes: &[u8; LANES], fast: &[FastTap], parents: &[u8]) -> [u8; LANES] {
    let mut states = [ESCAPED; LANES];
    // From the last tap back, so that each overwrites the lanes of the taps after it.
    for tap in fast.iter().rev() {
        let parent: &[u8; LANES] = parents[tap.offset..]
            .first_chunk()
            .expect("invariant: LANES places follow the last cell");
        for lane in 0..LANES {
            // Arithmetic where an `if` would do: LLVM vectorises this one.
            let chosen = u8::from(bytes[lane] <= tap.last[lane]).wrapping_neg();
            states[lane] ^= (states[lane] ^ parent[lane]) & chosen;
        }
    }
    states
}

/// Copies as many cells as a row has left; whole chunks without a call to `memcpy`.
fn copy_lanes(from: &[u8], to: &mut [u8]) {
    match (from.first_chunk::<LANES>(), to.first_chunk_mut::<LANES>()) {
        (Some(from), Some(to)) => *to = *from,
        _ => {
            let n_cells = from.len().min(to.len());
            to[..n_cells].copy_from_slice(&from[..n_cells]);
        }
    }
}

/// The high bit of every lane.
fn high_bits(lanes: &[u8; LANES]) -> u64 {
    let (words, _) = lanes.as_chunks::<8>();
    let bits = words.iter().enumerate().map(|(index, word)| {
        let high = (u64::from_le_bytes(*word) >> 7) & 0x0101_0101_0101_0101;
        // The product gathers bit 8i of `high` in bit 56 + i.
        let gathered = high.wrapping_mul(0x0102_0408_1020_4080) >> 56;
        gathered << (8 * index)
    });
    bits.fold(0, |all, bits| all | bits)
}

fn for_each_bit(mut bits: u64, mut visit: impl FnMut(u32)) {
    while bits != 0 {
        visit(bits.trailing_zeros());
        bits &= bits - 1;
    }
}
