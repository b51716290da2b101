//! Files of a report: written whole or not at all.

use std::fmt::Display;
use std::path::{Path, PathBuf};
use thiserror::Error;

/// Why a report could not be made.
#[derive(Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum ReportError {
    #[error("{what}: expected at least one policy run, got none")]
    Empty { what: &'static str },
    /// A number that cannot be drawn.
    #[error(
        "policy {policy:?} on world seed {world_seed}: {what}: expected a finite number, got {got}"
    )]
    NotFinite {
        policy: String,
        world_seed: u64,
        what: &'static str,
        got: f64,
    },
    /// Parts of a snapshot that do not belong together.
    #[error(transparent)]
    Snapshot(#[from] ::figures::Misfit),
    /// A file that could not be written.
    #[error("cannot write {}: {reason}", path.display())]
    Write {
        path: PathBuf,
        /// What the system or the encoder said.
        reason: String,
    },
}

/// Writes a file beside `path` and renames it, so that `path` is never half a file.
pub(crate) fn replace_file<E: Display>(
    path: &Path,
    extension: &str,
    write: impl FnOnce(&Path) -> Result<(), E>,
) -> Result<(), ReportError> {
    let failed = |reason: String| ReportError::Write {
        path: path.into(),
        reason,
    };
    let Some(name) = path.file_name() else {
        return Err(failed("the path names no file".into()));
    };
    let name = name.to_string_lossy();
    let temporary = path.with_file_name(format!(".{name}.{}.tmp.{extension}", std::process::id()));
    let written = write(&temporary).map_err(|error| error.to_string());
    let result =
        written.and_then(|()| std::fs::rename(&temporary, path).map_err(|error| error.to_string()));
    if result.is_err() {
        // It may not exist; the first error is the one to tell.
        let _ = std::fs::remove_file(&temporary);
    }
    result.map_err(failed)
}
