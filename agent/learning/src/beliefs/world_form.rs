//! The properties that a world must share with the worlds in which a belief was learned.

use anyhow::{Result, ensure};
use emberwatch_model::{Model, Shape};

/// The form of a world's observations.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WorldForm {
    pub shape: Shape,
    /// Number of values that can be observed in a cell, for all observation matrices together.
    pub n_observations: usize,
    /// Number of observation matrices of the sensor, at least 1.
    pub n_matrices: usize,
}

impl WorldForm {
    /// Returns the form of a model's worlds on a grid.
    pub fn of(model: &Model, shape: Shape) -> Self {
        Self {
            shape,
            n_observations: model.n_observations(),
            n_matrices: model.n_rings(),
        }
    }

    /// Checks a belief's number of observations, and its number of observation matrices.
    pub fn check_observations(&self, n_observations: usize, n_matrices: usize) -> Result<()> {
        let (expected, got) = (self.n_observations, n_observations);
        ensure!(
            got == expected,
            "checkpoint: expected the world's {expected} observations, got {got}"
        );
        let (expected, got) = (self.n_matrices, n_matrices);
        ensure!(
            got == expected,
            "checkpoint: expected the {expected} observation matrices of the world's sensor, got {got}: the checkpoint \
             belongs to worlds with another sensor"
        );
        Ok(())
    }
}
