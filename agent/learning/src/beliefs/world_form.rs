//! What a world must have in common with those that a belief was learned in.

use anyhow::{Result, ensure};
use emberwatch_model::{Model, Shape};

/// The form of a world's observations.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WorldForm {
    pub shape: Shape,
    /// Values that a cell may show, of all matrices together.
    pub n_observations: usize,
    /// Observation matrices of the sensor, at least 1.
    pub n_matrices: usize,
}

impl WorldForm {
    /// That of a model's worlds on a grid.
    pub fn of(model: &Model, shape: Shape) -> Self {
        Self {
            shape,
            n_observations: model.n_observations(),
            n_matrices: model.n_rings(),
        }
    }

    /// Refuses a belief about other observations.
    pub fn check_observations(&self, n_observations: usize, n_matrices: usize) -> Result<()> {
        let (expected, got) = (self.n_observations, n_observations);
        ensure!(
            got == expected,
            "checkpoint: expected {expected} observations as the world's, got {got}"
        );
        let (expected, got) = (self.n_matrices, n_matrices);
        ensure!(
            got == expected,
            "checkpoint: expected {expected} observation matrices as the world's sensor has, got {got}"
        );
        Ok(())
    }
}
