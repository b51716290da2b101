//! Standard output.

use anyhow::{Context, Result};
use std::io::Write;

/// Writes to standard output.
pub fn print(text: &str) -> Result<()> {
    std::io::stdout()
        .write_all(text.as_bytes())
        .context("write to standard output")
}
