//! The subcommands: flags in, library calls, text out.

mod print;
mod record;
mod replay;
mod running;
mod snapshots;

pub use print::print;
pub use record::RecordCommand;
pub use replay::ReplayCommand;
pub use running::{StatusCommand, StopCommand};
pub use snapshots::{ForkCommand, RestoreCommand, SnapshotCommand};
