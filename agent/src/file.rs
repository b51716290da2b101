//! Files that are written whole or not at all.

use anyhow::{Context, Result};
use std::fs::OpenOptions;
use std::io::Write;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

/// Who may read a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Readers {
    /// Whoever the process lets read its files.
    Any,
    Owner,
}

/// Writes a file beside `path` and renames it, so that readers find all or nothing.
///
/// # Errors
/// Names the file, which is then as it was.
pub fn replace_file(path: &Path, bytes: &[u8], readers: Readers) -> Result<()> {
    let written = || {
        let name = path.file_name().context("expected a file's name")?;
        let name = format!(".{}.{}", name.display(), std::process::id());
        let beside = path.with_file_name(name);
        // What an earlier process of this number left may have other readers.
        let _ = std::fs::remove_file(&beside);
        let mut options = OpenOptions::new();
        options.write(true).create_new(true);
        if readers == Readers::Owner {
            options.mode(0o600);
        }
        let written = options.open(&beside).and_then(|mut file| {
            file.write_all(bytes)?;
            file.sync_all()?;
            std::fs::rename(&beside, path)
        });
        if written.is_err() {
            // The first error is the one to tell.
            let _ = std::fs::remove_file(&beside);
        }
        anyhow::Ok(written?)
    };
    written().with_context(|| format!("write {}", path.display()))
}
