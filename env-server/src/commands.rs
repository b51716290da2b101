//! The subcommands: flags in, library calls, text out.

mod record;
mod replay;
mod running;
mod snapshots;

pub use record::RecordCommand;
pub use replay::ReplayCommand;
pub use running::{StatusCommand, StopCommand};
pub use snapshots::{ForkCommand, RestoreCommand, SnapshotCommand};

use anyhow::{Context, Result};
use std::io::Write;

/// Writes to standard output.
pub fn print(text: &str) -> Result<()> {
    std::io::stdout()
        .write_all(text.as_bytes())
        .context("write to standard output")
}
