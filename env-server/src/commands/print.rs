//! Printing to standard output.

use anyhow::{Context, Result};
use std::io::Write;

/// Prints a text. Unlike `print!`, returns an error instead of panicking if the text cannot be written.
pub fn print(text: &str) -> Result<()> {
    std::io::stdout()
        .write_all(text.as_bytes())
        .context("write to standard output")
}
