//! The subcommands that are clients of a running server.

mod snapshots;

pub use snapshots::{ForkCommand, RestoreCommand, SnapshotCommand};
