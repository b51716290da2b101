//! Snapshots: the state of worlds, encoded as bytes and stored in files.

mod error;
mod file;
mod folder;
mod format;
mod job;
mod settings;
#[cfg(test)]
mod tests;

pub use error::SnapshotError;
pub use file::{Durability, FileError, read, refused};
pub use folder::Folder;
pub use format::{NewEpisode, Snapshot, SnapshotWorld, decode, encode};
pub use job::{Done, Job, load};
pub use settings::{Settings, WorldSpec};
