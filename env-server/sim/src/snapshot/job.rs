//! Jobs that read or write snapshot files, for a thread that may wait for a disk.

use super::error::SnapshotError;
use super::file::{Durability, FileError, read, refused, write};
use super::folder::Folder;
use super::format::SnapshotWorld;
use super::settings::WorldSpec;
use crate::world::Episode;
use std::ops::Range;
use std::path::{Path, PathBuf};

#[derive(Debug)]
pub enum Job {
    Save {
        path: PathBuf,
        bytes: Vec<u8>,
    },
    Autosave {
        folder: Folder,
        durability: Durability,
        keep: usize,
        also_keep: Option<PathBuf>,
        bytes: Vec<u8>,
    },
    Load {
        path: PathBuf,
        worlds: Range<usize>,
    },
}

pub enum Done {
    Saved { path: PathBuf, n_bytes: usize },
    Loaded(Vec<SnapshotWorld<Box<Episode>>>),
}

impl Job {
    pub fn run(self, spec: &WorldSpec) -> Result<Done, FileError> {
        match self {
            Self::Save { path, bytes } => {
                write(&path, &bytes, Durability::PowerLoss)?;
                let n_bytes = bytes.len();
                Ok(Done::Saved { path, n_bytes })
            }
            Self::Autosave {
                folder,
                durability,
                keep,
                also_keep,
                bytes,
            } => {
                let path = folder.save(&bytes, durability, keep, also_keep.as_deref())?;
                let n_bytes = bytes.len();
                Ok(Done::Saved { path, n_bytes })
            }
            Self::Load { path, worlds } => Ok(Done::Loaded(load(spec, &path, Some(worlds))?)),
        }
    }
}

/// Reads worlds from a file, or all worlds if `worlds` is `None`.
pub fn load(
    spec: &WorldSpec,
    path: &Path,
    worlds: Option<Range<usize>>,
) -> Result<Vec<SnapshotWorld<Box<Episode>>>, FileError> {
    let mut snapshot = read(path)?;
    if let Some(worlds) = worlds {
        let got = snapshot.worlds.len();
        if worlds.end > got {
            let expected = format!("a file of at least {} worlds", worlds.end);
            return Err(refused(path, SnapshotError::n_worlds(expected, got)));
        }
        snapshot.worlds = snapshot.worlds.drain(worlds).collect();
    }
    snapshot.restore(spec).map_err(|error| refused(path, error))
}
