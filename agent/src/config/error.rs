//! Why settings are refused.

use thiserror::Error;

/// Why settings were refused.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// A file that cannot be read or is not of the form.
    #[error("config file {path}: {problem}")]
    File { path: String, problem: String },
    /// A bonus that is no number of a sensible size.
    #[error("objective.{setting}: expected 0 to 1000, got {got}")]
    Bonus { setting: &'static str, got: f32 },
    /// A setting that is no number of a sensible size.
    #[error("{setting}: expected 0 to {most}, got {got}")]
    Number {
        setting: &'static str,
        most: f64,
        got: f64,
    },
    /// A setting out of its range.
    #[error("{setting}: expected {least} to {most}, got {got}")]
    Range {
        setting: &'static str,
        least: usize,
        most: usize,
        got: usize,
    },
}
