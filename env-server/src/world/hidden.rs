//! The hidden state of one grid, a pure function of (model, seed, k).
//!
//! A world starts from the model's initial distribution, runs `burn_in` steps, and calls what it
//! reached k = 0. Its absolute step `burn_in + k` indexes the random streams, so that a world with
//! burn-in B at k equals the one without burn-in at B + k.

use protocol::{Dynamics, Grid};

/// The hidden states of one world at its present step.
#[derive(Debug, Clone)]
pub struct World {
    dynamics: Dynamics,
    states: Grid<u8>,
    seed: u64,
    burn_in: u64,
    step: u64,
}

impl World {
    /// Starts a world; simulates `burn_in` steps.
    pub fn new(mut dynamics: Dynamics, seed: u64, burn_in: u64) -> Self {
        let mut states = dynamics.initial(seed);
        for n in 0..burn_in {
            dynamics.step(seed, n, &mut states);
        }
        Self {
            dynamics,
            states,
            seed,
            burn_in,
            step: 0,
        }
    }

    /// A world at step k.
    pub fn at(dynamics: Dynamics, seed: u64, burn_in: u64, step: u64, states: Grid<u8>) -> Self {
        Self {
            dynamics,
            states,
            seed,
            burn_in,
            step,
        }
    }

    /// Moves the world from k to k + 1 (paper eq. 4, each cell drawn from `Phi` of the states).
    pub fn advance(&mut self) {
        self.dynamics
            .step(self.seed, self.absolute_step(), &mut self.states);
        self.step += 1;
    }

    /// Hidden states, shape `[H, W]`.
    pub fn states(&self) -> &Grid<u8> {
        &self.states
    }

    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// Step index k.
    pub fn step(&self) -> u64 {
        self.step
    }

    /// `burn_in + k`, which indexes random streams.
    pub fn absolute_step(&self) -> u64 {
        self.burn_in + self.step
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::{Model, Shape};

    fn world(seed: u64, burn_in: u64, steps: u64) -> World {
        let shape = Shape::new(64, 48).expect("test shape");
        let dynamics = Dynamics::new(&Model::wildfire(), shape).expect("valid model");
        let mut world = World::new(dynamics, seed, burn_in);
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
