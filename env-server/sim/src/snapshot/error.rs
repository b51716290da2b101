//! Why a snapshot is refused.

use thiserror::Error;

/// Why a snapshot is refused; each says what was expected and what is there.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum SnapshotError {
    /// The file is damaged; an older one may be whole.
    #[error("{0}")]
    Damaged(String),
    /// A snapshot of other settings or another version, or one that cannot be continued.
    #[error("{0}")]
    Unfit(String),
}

impl SnapshotError {
    /// The refusal of a file with other worlds than are wanted.
    pub fn n_worlds(expected: impl ToString, got: usize) -> Self {
        let expected = expected.to_string();
        Self::Unfit(format!("worlds: expected {expected}, got {got}"))
    }
}
