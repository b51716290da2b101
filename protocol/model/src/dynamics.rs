//! The transition of the hidden world: draws each cell of `X_{k+1}` given `X_k`.
//!
//! The result depends only on the model, the seed and the step, not on threads, platform or observers.
//!
//! `ratio` draws by the paper's rule, and `hazards` by that of models of hazards.
//!
//! # Random numbers
//! Two words of the step's ChaCha8 stream are the keys of two SplitMix64 generators, as for sensor noise. One generates
//! a byte for each cell, and the other the random numbers of the cells that their bytes do not decide. (On a 64 x 64
//! grid, a step that used only ChaCha8 spent 2.0 of its 7.1 us on random numbers.)

mod buffers;
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
use buffers::{Buffers, Keys};
use kernel::{invert, uniform};
use rand::Rng;
use std::sync::Arc;

/// The transition of a world for one model on one grid, with its buffers. Results do not depend on the buffers'
/// content. Each thread needs its own clone.
#[derive(Debug, Clone)]
pub struct Dynamics {
    shape: Shape,
    initial: Arc<[f64]>,
    tables: Tables,
    buffers: Buffers,
}

#[derive(Debug, Clone)]
enum Tables {
    Ratio(Arc<ratio::Tables>),
    Hazards(Arc<hazards::Tables>),
}

impl Dynamics {
    /// Makes the tables for a model on a grid.
    ///
    /// # Errors
    /// If a map of the model does not fit the grid, or eq. 3 could divide by zero in some cell ([`Model::check_on`]).
    pub fn new(model: &Model, shape: Shape) -> Result<Self, ModelError> {
        model.check_on(shape)?;
        let buffers = Buffers::new(model, shape);
        let n_states = model.n_states();
        let tables = match model.rule() {
            Rule::Ratio(it) => Tables::Ratio(ratio::Tables::new(it, &buffers.places).into()),
            Rule::Hazards(it) => {
                let tables = hazards::Tables::new(it, n_states, shape, &buffers.places);
                Tables::Hazards(tables.into())
            }
        };
        Ok(Self {
            shape,
            initial: model.initial().iter().copied().collect(),
            tables,
            buffers,
        })
    }

    /// Returns the size of the buffers for a model on a grid in bytes. Each clone has separate buffers.
    pub fn n_bytes(model: &Model, shape: Shape) -> usize {
        Buffers::n_bytes(model, shape)
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
        match &self.tables {
            Tables::Ratio(tables) => tables.advance(keys, buffers),
            Tables::Hazards(tables) => tables.advance(keys, buffers),
        }
        buffers.places.store(cells);
    }
}

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
