//! The transition of the hidden world: draws each cell of `X_{k+1}` given `X_k`.
//!
//! The result depends only on the model, the seed and the step, not on threads, platform or observers.
//!
//! [`ratio`] draws by the paper's rule, and [`hazards`] by that of models of hazards.
//!
//! # Random numbers
//! Two words of the step's ChaCha8 stream are the keys of two SplitMix64 generators, as for sensor noise. One generates
//! a byte for each cell, and the other the random numbers of the cells that their bytes do not decide. (On a 64 x 64
//! grid, a step that used only ChaCha8 spent 2.0 of its 7.1 us on random numbers.)

mod bytes;
mod hazards;
mod kernel;
mod lanes;
mod mixture;
mod parents;
mod places;
mod ratio;

use super::file::ModelError;
use super::grid::{Grid, Shape};
use super::parameters::{Model, Rule};
use super::randomness::{Purpose, stream};
use super::vectors::vectorised;
use kernel::{invert, uniform};
use lanes::{LANES, high_bits, list_lanes, transposed};
use places::Places;
use rand::Rng;
use std::ops::Range;
use std::sync::Arc;

/// The keys of a step's generators: for the bytes and for the draws.
type Keys = [u64; 2];

/// Number of cells in a band, a multiple of [`LANES`]. Each band is finished before the next one begins, so that its
/// bytes, states and lists stay in a 32 KiB cache.
const BAND: usize = 8192;

/// The transition of a world for one model on one grid, with its buffers. Results do not depend on the buffers'
/// content. Each thread needs its own clone.
#[derive(Debug, Clone)]
pub struct Dynamics {
    shape: Shape,
    initial: Arc<[f64]>,
    tables: Tables,
    buffers: Buffers,
}

/// The tables of a model and grid, which all worlds share.
#[derive(Debug, Clone)]
enum Tables {
    Ratio(Arc<ratio::Tables>),
    Hazards(Arc<hazards::Tables>),
}

#[derive(Debug, Clone)]
struct Buffers {
    places: Places,
    /// One bit per home (see `places.rs`), which is set if a cell of the grid has this home.
    on_grid: Arc<[u64]>,
    /// The marked cells of a band, each as the index of its home.
    listed: Vec<u32>,
    /// Random numbers for the marked cells.
    randoms: Vec<u8>,
}

impl Dynamics {
    /// Makes the tables for a model on a grid.
    ///
    /// # Errors
    /// If a map of the model does not fit the grid, or eq. 3 could divide by zero in some cell ([`Model::check_on`]).
    pub fn new(model: &Model, shape: Shape) -> Result<Self, ModelError> {
        model.check_on(shape)?;
        let places = Places::new(model, shape);
        let n_states = model.n_states();
        let tables = match model.rule() {
            Rule::Ratio(it) => Tables::Ratio(ratio::Tables::new(it, &places).into()),
            Rule::Hazards(it) => {
                Tables::Hazards(hazards::Tables::new(it, n_states, shape, &places).into())
            }
        };
        let in_band = places.next.len().min(BAND);
        Ok(Self {
            shape,
            initial: model.initial().iter().copied().collect(),
            tables,
            buffers: Buffers {
                on_grid: on_grid(shape, &places).into(),
                places,
                listed: vec![0; in_band + LANES],
                randoms: vec![0; in_band * size_of::<u32>()],
            },
        })
    }

    /// Returns the size of the buffers for a model on a grid in bytes. Each clone has separate buffers.
    pub fn n_bytes(model: &Model, shape: Shape) -> usize {
        let (n_places, n_homes) = Places::lengths(model, shape);
        let in_band = n_homes.min(BAND);
        n_places + n_homes + (2 * in_band + LANES) * size_of::<u32>()
    }

    /// Draws the states at step 0 of a world, each cell from the model's initial distribution.
    pub fn initial(&self, seed: u64) -> Grid<u8> {
        let mut rng = stream(seed, Purpose::Initial, 0);
        Grid::from_shape_simple_fn(self.shape.dim(), || {
            invert(&self.initial, uniform(rng.next_u64()))
        })
    }

    /// Advances the states of a world from step `n` to step `n + 1`.
    ///
    /// # Panics
    /// If `states` has a different shape, is not row-major, or contains a value that is not a state.
    pub fn step(&mut self, seed: u64, n: u64, states: &mut Grid<u8>) {
        assert_eq!(states.dim(), self.shape.dim(), "states: expected [H, W]");
        let cells = states.as_slice_mut().expect("states: expected row-major");
        let keys = keys(seed, n);
        vectorised(
            #[inline(always)]
            || self.advance(keys, cells),
        );
    }

    #[inline(always)] // Like the functions it calls, so that all are compiled for this processor's vectors.
    fn advance(&mut self, keys: Keys, cells: &mut [u8]) {
        let largest = cells.iter().fold(0, |most, &state| state.max(most));
        assert!(
            usize::from(largest) < self.initial.len(),
            "states: expected values below S"
        );
        let buffers = &mut self.buffers;
        buffers.places.load(cells);
        let n_homes = buffers.places.next.len();
        let bands = (0..n_homes).step_by(BAND);
        let bands = bands.map(|first| first..n_homes.min(first + BAND));
        match &self.tables {
            Tables::Ratio(tables) => tables.advance(keys, bands, buffers),
            Tables::Hazards(tables) => tables.advance(keys, bands, buffers),
        }
        buffers.places.store(cells);
    }
}

impl Buffers {
    /// Lists the homes of the cells in a band whose next state is a mark, with its high bit set. Returns their number.
    #[inline(never)] // If it were inlined, LLVM would run out of registers, and a step would take 10 % longer.
    fn list_marked(&mut self, band: Range<usize>) -> usize {
        let (chunks, _) = self.places.next[band.clone()].as_chunks();
        let on_grid = &self.on_grid[band.start / LANES..];
        let mut n_listed = 0;
        for ((home, lanes), on_grid) in band.step_by(LANES).zip(chunks).zip(on_grid) {
            let bits = high_bits(lanes) & on_grid;
            let to = self.listed[n_listed..]
                .first_chunk_mut()
                .expect("invariant: the list is LANES longer than a band");
            list_lanes(bits, home as u32, to);
            n_listed += bits.count_ones() as usize;
        }
        n_listed
    }
}

/// Returns one bit per home, in the order of [`high_bits`], which is set if a cell of the grid has this home.
fn on_grid(shape: Shape, places: &Places) -> Vec<u64> {
    let mut bits = vec![0; places.next.len() / LANES];
    for row in 0..shape.height() {
        let first = places.home(row, 0);
        for home in first..first + shape.width() {
            bits[home / LANES] |= 1_u64 << transposed((home % LANES) as u32);
        }
    }
    bits
}

/// Returns the keys of a step.
fn keys(seed: u64, n: u64) -> Keys {
    let mut rng = stream(seed, Purpose::Transition, n);
    [rng.next_u64(), rng.next_u64()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wider_vectors_do_not_change_any_cell() {
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
            assert!(states.iter().any(|&state| state == 2), "{name}");
        }
    }
}
