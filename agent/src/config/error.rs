//! Why settings are refused.

use thiserror::Error;

/// Why settings were refused.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// A file that cannot be read or is not of the form.
    #[error("config file {path}: {problem}")]
    File {
        /// Its path.
        path: String,
        /// What is wrong.
        problem: String,
    },
    /// A bonus that is no number of a sensible size.
    #[error("objective.{setting}: expected 0 to 1000, got {got}")]
    Bonus {
        /// Which setting.
        setting: &'static str,
        /// What it is.
        got: f32,
    },
    /// A setting that is no number of a sensible size.
    #[error("{setting}: expected 0 to {most}, got {got}")]
    Number {
        /// Which setting.
        setting: &'static str,
        /// Greatest value allowed.
        most: f64,
        /// What it is.
        got: f64,
    },
    /// A setting out of its range.
    #[error("{setting}: expected {least} to {most}, got {got}")]
    Range {
        /// Which setting.
        setting: &'static str,
        /// Least value allowed.
        least: usize,
        /// Greatest value allowed.
        most: usize,
        /// What it is.
        got: usize,
    },
}
