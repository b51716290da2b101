//! The subcommands: flags in, library calls, text out.

mod record;
mod replay;
mod running;

pub use record::RecordCommand;
pub use replay::ReplayCommand;
pub use running::{StatusCommand, StopCommand};

use anyhow::{Context, Result};
use std::io::Write;

/// Writes to standard output.
pub fn print(text: &str) -> Result<()> {
    std::io::stdout()
        .write_all(text.as_bytes())
        .context("write to standard output")
}
