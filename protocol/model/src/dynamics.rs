//! The transition of the hidden world: draws each cell of `X_{k+1}` from `Phi(one-hot X_k)` (paper eqs. 2 to 4).
//!
//! The result depends only on the model, the seed and the step, not on threads, platform or observers.
//!
//! # What is drawn
//! A *tap* is a position in the kernel, and so an offset from a cell to a neighbour. A neighbour's weights are its
//! *vote*: with the neighbour at tap `t` in state `n_t`, the weight of next state `m` is `b[m] + sum_t w[m, n_t, t]`
//! (eq. 2). The cell changes to `m` with a probability proportional to this weight (eqs. 3 and 4). `Tables::weights`
//! and `Dynamics::sum_kernels` compute exactly this.
//!
//! # How it is fast
//! Two faster methods, which draw from the same distribution, are tried first. `bytes.rs` decides most cells of a row
//! with one random byte each. For each remaining cell, `parents.rs` then draws one neighbour and this neighbour's vote,
//! up to eight times. Only cells that are still undecided need the full sum. The wildfire model has hardly any such
//! cells. A model with too many weights for tables needs the full sum for every cell.
//!
//! # Random numbers
//! Two words of the step's ChaCha8 stream are the keys of two SplitMix64 generators, as for sensor noise. One generates
//! the bytes and the other the random numbers of the draws, band by band. (On a 64 x 64 grid, a step that used only
//! ChaCha8 spent 2.0 of its 7.1 us on random numbers.)

mod bytes;
mod kernel;
mod lanes;
mod mixture;
mod parents;
mod places;

use super::file::{MAX_VALUES, ModelError};
use super::grid::{Grid, Shape};
use super::parameters::Model;
use super::randomness::{Purpose, stream};
use super::vectors::vectorised;
use bytes::Bytes;
use kernel::{Kernel, invert, uniform};
use lanes::{LANES, Words};
use mixture::Mixture;
use parents::Parents;
use places::{OFF_GRID, Places, centre};
use rand::Rng;
use std::sync::Arc;

/// Number of cells in a band, a multiple of [`LANES`]. Each band is finished before the next one begins, so that its
/// bytes, states and lists stay in a 32 KiB cache.
const BAND: usize = 8192;

/// The transition of a world for one model on one grid, with its buffers. Results do not depend on the buffers'
/// content. Each thread needs its own clone.
#[derive(Debug, Clone)]
pub struct Dynamics {
    shape: Shape,
    tables: Arc<Tables>,
    places: Places,
    /// The undecided cells of a band, each as the index of its home (see `places.rs`).
    undecided: Vec<u32>,
    /// Random numbers for the undecided cells.
    randoms: Vec<u8>,
}

/// The tables computed from the model and the grid, which all worlds share.
#[derive(Debug)]
struct Tables {
    n_states: usize,
    initial: Vec<f64>,
    /// The kernels, zone by zone. Each zone has one kernel, or one for each own state (the state of the cell itself).
    kernels: Vec<Kernel>,
    /// Number of kernels per zone.
    n_own: usize,
    /// The zone of each cell, indexed by home (see `places.rs`), if the model has several zones.
    zones: Option<Vec<u8>>,
    /// For each tap, the offset of the neighbour from the cell's home (see `places.rs`).
    offsets: Vec<usize>,
    bytes: Bytes,
    /// `None` if the model has too many weights for tables. Then every cell needs the full sum of eq. 2.
    parents: Option<Parents>,
}

impl Dynamics {
    /// Makes the tables for a model on a grid.
    ///
    /// # Errors
    /// [`ModelError::ZeroWeight`] if eq. 3 could divide by zero in some cell ([`Model::check_on`]).
    pub fn new(model: &Model, shape: Shape) -> Result<Self, ModelError> {
        model.check_on(shape)?;
        let places = Places::new(model, shape);
        let in_band = places.next.len().min(BAND);
        Ok(Self {
            shape,
            tables: Arc::new(Tables::new(model, shape, &places)),
            places,
            undecided: vec![0; in_band + LANES],
            randoms: vec![0; in_band * size_of::<u32>()],
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
            invert(&self.tables.initial, uniform(rng.next_u64()))
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
    fn advance(&mut self, [byte_key, draw_key]: [u64; 2], cells: &mut [u8]) {
        let largest = cells.iter().fold(0, |most, &state| state.max(most));
        assert!(
            usize::from(largest) < self.tables.n_states,
            "states: expected values below S"
        );
        self.places.load(cells);
        let tables = Arc::clone(&self.tables);
        let mut words = Words::new(draw_key);
        for first in (0..self.places.next.len()).step_by(BAND) {
            let end = self.places.next.len().min(first + BAND);
            tables.bytes.decide(&mut self.places, first..end, byte_key);
            let mut n_undecided =
                tables
                    .bytes
                    .list_undecided(&self.places, first..end, &mut self.undecided);
            if let Some(parents) = &tables.parents {
                let undecided = &mut self.undecided[..n_undecided];
                n_undecided =
                    parents.decide(&mut self.places, undecided, &mut self.randoms, &mut words);
            }
            self.sum_kernels(n_undecided, &mut words);
        }
        self.places.store(cells);
    }

    /// Decides the remaining cells with the full sum of eq. 2.
    fn sum_kernels(&mut self, n_undecided: usize, words: &mut Words) {
        for &home in &self.undecided[..n_undecided] {
            let home = home as usize;
            let weights = self.tables.weights(home, &self.places.states[home..]);
            let weights = &weights[..self.tables.n_states];
            self.places.next[home] = invert(weights, uniform(words.draw()));
        }
    }
}

impl Tables {
    fn new(model: &Model, shape: Shape, places: &Places) -> Self {
        let kernels = Kernel::of_model(model);
        let mixtures = Mixture::of_kernels(&kernels, model.n_zones(), model.sees_own_state());
        let (offsets, zones) = (places.offsets(model), places.zones(model));
        let parents = Parents::new(&mixtures, &offsets, zones.as_deref());
        // Without `parents`, bytes must not decide any cell, because the full sum draws from the whole distribution
        // instead of the residual one.
        let by_bytes = if parents.is_some() {
            &mixtures[..]
        } else {
            &[]
        };
        Self {
            n_states: model.n_states(),
            initial: model.initial().to_vec(),
            bytes: Bytes::new(by_bytes, &offsets, shape, places.stride, zones.as_deref()),
            parents,
            n_own: kernels.len() / model.n_zones(),
            kernels,
            zones,
            offsets,
        }
    }

    /// Computes eq. 2: the weight of each next state of a cell. `states` is the part of the buffer that begins at the
    /// cell's home.
    fn weights(&self, home: usize, states: &[u8]) -> [f64; MAX_VALUES] {
        let zone = self.zones.as_ref().map_or(0, |zones| zones[home]);
        let of_zone = &self.kernels[usize::from(zone) * self.n_own..][..self.n_own];
        let kernel = match of_zone {
            [kernel] => kernel,
            by_own_state => &by_own_state[usize::from(states[centre(&self.offsets)])],
        };
        let mut sums = [0.0; MAX_VALUES];
        for (tap, &offset) in self.offsets.iter().enumerate() {
            let neighbour = states[offset];
            if neighbour != OFF_GRID {
                let weights = kernel.weights(tap, usize::from(neighbour));
                sums.iter_mut().zip(weights).for_each(|(sum, w)| *sum += w);
            }
        }
        sums
    }
}

/// Returns the keys of the two generators of a step: for the bytes and for the draws.
fn keys(seed: u64, n: u64) -> [u64; 2] {
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
