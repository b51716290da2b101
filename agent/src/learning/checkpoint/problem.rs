//! What may be wrong with a checkpoint.

use crate::estimation::belief::Belief;
use protocol::Shape;
use std::fmt::Display;
use std::path::{Path, PathBuf};
use thiserror::Error;

/// Largest file that is written or read, bytes: 200 times what a full replay of 64 x 64 cells and 3
/// states needs.
pub const MAX_BYTES: u64 = 1 << 32;

/// Largest count: far from where one more would not fit.
const MAX_COUNT: u64 = 1 << 53;

/// Why a checkpoint could not be written or was refused.
#[derive(Debug, Error)]
#[error("checkpoint {}: {problem}", path.display())]
pub struct CheckpointError {
    path: PathBuf,
    problem: Problem,
}

/// What is wrong with a checkpoint.
#[derive(Debug, Error)]
pub enum Problem {
    #[error("{0}")]
    Io(#[from] std::io::Error),
    /// The form is right and the numbers are not those that were written.
    #[error("expected contents with digest {expected}, got {got}: the file is damaged")]
    Digest { expected: String, got: String },
    #[error(transparent)]
    Network(#[from] ::network::NetworkError),
    /// Contents that the program cannot work with: what, expected and got.
    #[error("{0}")]
    Unfit(String),
}

impl Problem {
    pub fn of(self, path: &Path) -> CheckpointError {
        let path = path.to_owned();
        let problem = self;
        CheckpointError { path, problem }
    }

    /// What is wrong with the file as a whole.
    pub fn whole(expected: impl Display, got: impl Display) -> Self {
        Self::Unfit(format!("expected {expected}, got {got}"))
    }

    /// What is wrong with a tensor or a field of the state.
    pub fn value(name: &str, expected: impl Display, got: impl Display) -> Self {
        Self::Unfit(format!("{name}: expected {expected}, got {got}"))
    }
}

/// Refuses a field that does not fit.
pub fn check(
    fits: bool,
    name: &str,
    expected: impl Display,
    got: impl Display,
) -> Result<(), Problem> {
    match fits {
        true => Ok(()),
        false => Err(Problem::value(name, expected, got)),
    }
}

pub fn check_counts(counts: &[(&str, u64)]) -> Result<(), Problem> {
    let expected = format!("at most {MAX_COUNT}");
    let mut counts = counts.iter();
    counts.try_for_each(|&(name, count)| check(count <= MAX_COUNT, name, &expected, count))
}

/// Refuses other than so many finite numbers.
pub fn check_numbers<T: Copy + Into<f64>>(
    name: &str,
    numbers: &[T],
    length: usize,
) -> Result<(), Problem> {
    let mut floats = numbers.iter().map(|&number| number.into());
    let wrong = floats.find(|number: &f64| !number.is_finite());
    let got = wrong.unwrap_or(numbers.len() as f64);
    let fits = wrong.is_none() && numbers.len() == length;
    check(fits, name, format!("{length} finite numbers"), got)
}

/// Refuses a belief about other states or on another grid.
pub fn check_belief(
    name: &str,
    belief: &Belief,
    n_states: usize,
    shape: Shape,
) -> Result<(), Problem> {
    let expected = format!("{n_states} states on {shape}");
    let got = format!("{} states on {}", belief.n_states(), belief.shape());
    check(got == expected, name, &expected, &got)
}
