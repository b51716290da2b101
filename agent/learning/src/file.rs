//! Files that are written completely or not at all.

use anyhow::{Context, Result};
use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

/// Writes a temporary file next to `path` and renames it, so that readers always find a complete file. A symbolic link
/// stays one, and its target is replaced.
///
/// # Errors
/// If the system reports an error. The error names the file, which remains unchanged.
pub fn replace_file(path: &Path, bytes: &[u8]) -> Result<()> {
    let written = || {
        let target = target(path);
        let (temporary, mut file) = create_temporary(&target)?;
        let written = file
            .write_all(bytes)
            .and_then(|()| file.sync_all())
            .and_then(|()| std::fs::rename(&temporary, &target));
        if written.is_err() {
            // Only the first error is reported.
            let _ = std::fs::remove_file(&temporary);
        }
        anyhow::Ok(written?)
    };
    written().with_context(|| format!("write {}", path.display()))
}

/// Checks that [`replace_file`] can create its temporary file. Call this before a long computation whose result will be
/// saved.
///
/// # Errors
/// If the temporary file cannot be created. The error names the file and the system's reason.
pub fn check_replaceable(path: &Path) -> Result<()> {
    let created = create_temporary(&target(path));
    let checked = created.and_then(|(temporary, _)| Ok(std::fs::remove_file(temporary)?));
    checked.with_context(|| format!("write {}", path.display()))
}

fn target(path: &Path) -> PathBuf {
    std::fs::canonicalize(path).unwrap_or_else(|_| path.into())
}

fn create_temporary(path: &Path) -> Result<(PathBuf, File)> {
    let name = path.file_name().context("expected the name of a file")?;
    let name = format!(".{}.{}", name.display(), std::process::id());
    let temporary = path.with_file_name(name);
    // An earlier process with the same ID may have left a file with different permissions.
    let _ = std::fs::remove_file(&temporary);
    let file = File::create_new(&temporary)?;
    Ok((temporary, file))
}
