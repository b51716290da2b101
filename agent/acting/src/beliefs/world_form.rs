//! The properties that a world must share with the worlds in which a belief was learned.

use anyhow::{Result, ensure};
use emberwatch_model::{Model, Shape};

/// The form of a world's observations.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WorldForm {
    pub shape: Shape,
    /// Number of values that can be observed in a cell.
    pub n_observations: usize,
}

impl WorldForm {
    /// Returns the form of a model's worlds on a grid.
    pub fn of(model: &Model, shape: Shape) -> Self {
        Self {
            shape,
            n_observations: model.n_observations(),
        }
    }

    /// Checks a belief's number of observations.
    pub fn check_observations(&self, got: usize) -> Result<()> {
        let expected = self.n_observations;
        ensure!(
            got == expected,
            "checkpoint: expected the world's {expected} observations, got {got}"
        );
        Ok(())
    }
}
