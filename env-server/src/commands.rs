//! The subcommands: each parses flags, calls the library and prints the result.

mod record;
mod running;
mod snapshots;

pub use record::RecordCommand;
pub use running::{StatusCommand, StopCommand};
pub use snapshots::{ForkCommand, RestoreCommand, SnapshotCommand};
