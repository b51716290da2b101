//! The belief before the first frame: the predictor `u_0` of paper section III.A.

use crate::estimation::belief::Belief;
use emberwatch_model::dynamics::Dynamics;
use emberwatch_model::grid::{Grid, Probabilities, Shape};
use emberwatch_model::randomness::{Purpose, stream};
use emberwatch_model::{Model, ModelError};
use ndarray::{Array3, Axis};
use rand_chacha::rand_core::Rng;
use rayon::prelude::*;
use std::sync::atomic::{AtomicBool, Ordering};

/// Weight of the grid-wide average in a cell's prior, as a number of worlds. The value hardly matters, because the
/// first frames soon outweigh the prior.
const POOLED_WORLDS: f64 = 16.0;

/// A kind of belief before the first frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Prior {
    /// The frequency of each state in each cell of simulated worlds after burn-in. No better belief is possible before
    /// the first frame.
    Simulated {
        n_worlds: usize,
        /// Number of simulated steps, starting from the initial distribution.
        burn_in: u64,
    },
    /// The model's initial distribution, which is exact for a world without burn-in.
    Initial,
    /// The same probability for every state, as in the authors' demonstration.
    Uniform,
}

impl Prior {
    /// The default number of simulated worlds: 64.
    pub const N_WORLDS: usize = 64;

    /// Returns the belief before the first frame. Only [`Prior::Simulated`] uses `seed`.
    ///
    /// # Errors
    /// If the model cannot be simulated on the grid.
    pub fn belief(self, model: &Model, shape: Shape, seed: u64) -> Result<Belief, ModelError> {
        let belief = self.belief_unless(&AtomicBool::new(false), model, shape, seed)?;
        Ok(belief.expect("invariant: nothing cancels it"))
    }

    /// Like [`Self::belief`], but returns `None` once `cancelled` is set, because a simulation can take minutes.
    pub fn belief_unless(
        self,
        cancelled: &AtomicBool,
        model: &Model,
        shape: Shape,
        seed: u64,
    ) -> Result<Option<Belief>, ModelError> {
        match self {
            Self::Simulated { n_worlds, burn_in } => {
                let simulation = Simulation {
                    dynamics: Dynamics::new(model, shape)?,
                    dim: (model.n_states(), shape.height(), shape.width()),
                    seed,
                    burn_in,
                    cancelled,
                };
                let counts = simulation.counts(n_worlds);
                let is_whole = !cancelled.load(Ordering::Relaxed);
                Ok(is_whole.then(|| average(&counts, model.n_states(), shape)))
            }
            Self::Initial => Ok(Some(Belief::from_initial(model, shape))),
            Self::Uniform => Ok(Some(Belief::uniform(model.n_states(), shape))),
        }
    }
}

struct Simulation<'a> {
    dynamics: Dynamics,
    dim: (usize, usize, usize),
    seed: u64,
    burn_in: u64,
    cancelled: &'a AtomicBool,
}

impl Simulation<'_> {
    /// Counts are integers, so the order in which threads add them does not matter.
    fn counts(&self, n_worlds: usize) -> Array3<u32> {
        let none = || Array3::zeros(self.dim);
        let count = |mut counts: Array3<u32>, world: usize| {
            for ((row, col), &state) in self.world(world).indexed_iter() {
                counts[[usize::from(state), row, col]] += 1;
            }
            counts
        };
        let counts = (0..n_worlds).into_par_iter().fold(none, count);
        counts.reduce(none, |a, b| a + b)
    }

    fn world(&self, world: usize) -> Grid<u8> {
        let world_seed = stream(self.seed, Purpose::Prior, world as u64).next_u64();
        let mut dynamics = self.dynamics.clone();
        let mut states = dynamics.initial(world_seed);
        for n in 0..self.burn_in {
            if self.cancelled.load(Ordering::Relaxed) {
                break;
            }
            dynamics.step(world_seed, n, &mut states);
        }
        states
    }
}

/// A few worlds say little about one cell, and a state that never occurred in a cell is still possible there.
fn average(counts: &Array3<u32>, n_states: usize, shape: Shape) -> Belief {
    let in_all = |state: usize| -> u32 { counts.index_axis(Axis(0), state).sum() };
    let totals: Vec<f64> = (0..n_states)
        .map(|state| f64::from(in_all(state)))
        .collect();
    let total: f64 = totals.iter().sum();
    // Add-one smoothing, so that a state that never occurred in the simulations keeps a positive probability.
    let pooled = |state: usize| (totals[state] + 1.0) / (total + n_states as f64);
    let n_worlds = total / shape.n_cells() as f64;
    let probability = |(state, row, col): (usize, usize, usize)| {
        let seen = f64::from(counts[[state, row, col]]);
        ((seen + POOLED_WORLDS * pooled(state)) / (n_worlds + POOLED_WORLDS)) as f32
    };
    Belief::from_probabilities(Probabilities::from_shape_fn(counts.dim(), probability))
        .expect("invariant: relative frequencies sum to one")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn simulated(n_worlds: usize, burn_in: u64) -> Prior {
        Prior::Simulated { n_worlds, burn_in }
    }

    #[test]
    fn a_simulated_prior_is_the_same_on_any_number_of_threads() {
        let shape = Shape::new(9, 12).expect("test shape");
        let model = Model::wildfire();
        let on = |n_threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads);
            let belief = || simulated(10, 40).belief(&model, shape, 5);
            let pool = pool.build().expect("threads");
            pool.install(belief).expect("valid model")
        };
        assert_eq!(on(1), on(3));
        let other = simulated(10, 40).belief(&model, shape, 6);
        assert_ne!(Ok(on(1)), other, "another seed");
    }

    #[test]
    fn a_cancelled_simulation_returns_no_belief() {
        let shape = Shape::new(9, 12).expect("test shape");
        let endless = simulated(3, u64::MAX);
        let cancelled = AtomicBool::new(true);
        let belief = endless.belief_unless(&cancelled, &Model::wildfire(), shape, 5);
        assert_eq!(belief, Ok(None));
    }

    #[test]
    fn without_burn_in_it_approaches_the_initial_distribution() {
        let shape = Shape::new(20, 20).expect("test shape");
        let prior = simulated(64, 0).belief(&Model::wildfire(), shape, 0);
        let prior = prior.expect("valid model");
        let mean = prior.probability(1).mean().expect("not empty");
        // Each of 25,600 cells is latent with probability .01, so four standard errors of the mean are .0025.
        assert!((mean - 0.01).abs() < 0.0025, "{mean}");
        assert!(prior.view().iter().all(|&p| p > 0.0));
    }
}
