//! Files that are written whole or not at all.

use anyhow::{Context, Result};
use std::fs::{File, OpenOptions};
use std::io::Write;
#[cfg(unix)]
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

/// Who may read a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Readers {
    /// Whoever the process lets read its files.
    Any,
    Owner,
}

/// Writes a temporary file next to `path` and renames it, so that readers find all or nothing.
///
/// # Errors
/// Names the file, which is then as it was.
pub fn replace_file(path: &Path, bytes: &[u8], readers: Readers) -> Result<()> {
    let written = || {
        let (temporary, mut file) = create_temporary(path, readers)?;
        let written = file
            .write_all(bytes)
            .and_then(|()| file.sync_all())
            .and_then(|()| std::fs::rename(&temporary, path));
        if written.is_err() {
            // The first error is the one to report.
            let _ = std::fs::remove_file(&temporary);
        }
        anyhow::Ok(written?)
    };
    written().with_context(|| format!("write {}", path.display()))
}

/// Checks that [`replace_file`] can create its temporary file, before the work whose result it is to hold.
///
/// # Errors
/// Names the file, with the system's reason.
pub fn check_replaceable(path: &Path) -> Result<()> {
    let created = create_temporary(path, Readers::Owner);
    let checked = created.and_then(|(temporary, _)| Ok(std::fs::remove_file(temporary)?));
    checked.with_context(|| format!("write {}", path.display()))
}

fn create_temporary(path: &Path, readers: Readers) -> Result<(PathBuf, File)> {
    let name = path.file_name().context("expected a file's name")?;
    let name = format!(".{}.{}", name.display(), std::process::id());
    let temporary = path.with_file_name(name);
    // A file that an earlier process of this number left may have other readers.
    let _ = std::fs::remove_file(&temporary);
    let mut options = OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    if readers == Readers::Owner {
        options.mode(0o600);
    }
    #[cfg(not(unix))]
    let _ = readers; // A file has the readers of its folder.
    let file = options.open(&temporary)?;
    Ok((temporary, file))
}
