//! Errors of snapshots.

use thiserror::Error;

#[derive(Debug, Error, PartialEq, Eq)]
pub enum SnapshotError {
    /// The file is damaged. The caller may try an older file, which may be intact.
    #[error("{0}")]
    Damaged(String),
    /// The snapshot has different settings, another version or invalid values.
    #[error("{0}")]
    Unfit(String),
}

impl SnapshotError {
    pub fn n_worlds(expected: impl ToString, got: usize) -> Self {
        let expected = expected.to_string();
        Self::Unfit(format!("worlds: expected {expected}, got {got}"))
    }
}
