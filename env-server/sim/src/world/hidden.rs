//! The hidden states of one world: a pure function of (model or recorded sequences, seed, k).
//!
//! A simulated world starts from the model's initial distribution and runs `burn_in` steps, which lead to k = 0. The
//! absolute step `burn_in + k` selects the random streams. So a world with a burn-in of B steps at step k equals a
//! world without a burn-in at step B + k.

use super::recorded::Recorded;
use emberwatch_model::{Dynamics, Grid};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

#[derive(Debug, Clone)]
pub enum Source {
    Simulated(Dynamics),
    Recorded(Arc<Recorded>),
}

#[derive(Debug, Clone)]
pub struct World {
    source: Source,
    states: Grid<u8>,
    seed: u64,
    burn_in: u64,
    step: u64,
}

impl Source {
    pub(super) fn last_step(&self, seed: u64) -> Option<u64> {
        match self {
            Self::Simulated(_) => None,
            Self::Recorded(recorded) => Some(recorded.last_step(seed)),
        }
    }
}

impl World {
    pub fn new(mut source: Source, seed: u64, burn_in: u64, ended: &AtomicBool) -> Self {
        let states = match &mut source {
            Source::Recorded(recorded) => recorded.states(seed, 0),
            Source::Simulated(dynamics) => {
                let mut states = dynamics.initial(seed);
                for n in (0..burn_in).take_while(|_| !ended.load(Ordering::Relaxed)) {
                    dynamics.step(seed, n, &mut states);
                }
                states
            }
        };
        Self::at(source, seed, burn_in, 0, states)
    }

    pub fn at(source: Source, seed: u64, burn_in: u64, step: u64, states: Grid<u8>) -> Self {
        Self {
            source,
            states,
            seed,
            burn_in,
            step,
        }
    }

    /// Moves the world from k to k + 1: draws each cell's next state from the distribution `Phi`, given the current
    /// states (paper eq. 4).
    ///
    /// # Panics
    /// If a recorded sequence has ended.
    pub fn advance(&mut self) {
        let n = self.absolute_step();
        self.step += 1;
        match &mut self.source {
            Source::Simulated(dynamics) => dynamics.step(self.seed, n, &mut self.states),
            Source::Recorded(recorded) => recorded.show(self.seed, self.step, &mut self.states),
        }
    }

    /// Returns the hidden states, shape `[H, W]`.
    pub fn states(&self) -> &Grid<u8> {
        &self.states
    }

    pub fn seed(&self) -> u64 {
        self.seed
    }

    pub fn step(&self) -> u64 {
        self.step
    }

    /// Returns `burn_in + k`, the index of the random streams.
    pub fn absolute_step(&self) -> u64 {
        self.burn_in + self.step
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberwatch_model::{Model, Shape};

    fn world(seed: u64, burn_in: u64, steps: u64) -> World {
        let shape = Shape::new(64, 48).expect("test shape");
        let dynamics = Dynamics::new(&Model::wildfire(), shape).expect("valid model");
        let mut world = World::new(
            Source::Simulated(dynamics),
            seed,
            burn_in,
            &AtomicBool::new(false),
        );
        (0..steps).for_each(|_| world.advance());
        world
    }

    #[test]
    fn a_world_is_a_function_of_seed_and_absolute_step() {
        assert_eq!(world(3, 0, 300).states(), world(3, 100, 200).states());
        assert_ne!(world(3, 0, 300).states(), world(4, 0, 300).states());
        assert_ne!(world(3, 0, 300).states(), world(3, 0, 299).states());
    }
}
