//! Reads and writes snapshot files. A file is written completely or not at all.

use super::error::SnapshotError;
use super::format::{HEADER_BYTES, MAGIC, MAX_BYTES, Snapshot, checked_length, decode};
use std::fs::{File, OpenOptions};
use std::io::{self, Read, Write};
#[cfg(unix)]
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use thiserror::Error;

const NOT_A_FILE: &str = "expected a regular file, got a folder, link, pipe or device";

/// Ending of a file's name while it is being written.
pub(super) const PART: &str = ".part";

static N_PARTS: AtomicU64 = AtomicU64::new(0);

#[derive(Debug, Error)]
#[error("snapshot file {path}: {problem}")]
pub struct FileError {
    pub path: String,
    pub problem: String,
    /// Whether the file is damaged, so that an older one should be tried.
    pub is_damaged: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Durability {
    /// The death of any process.
    Kill,
    /// The death of any process and a loss of power, because the data has reached the disk. This takes some
    /// milliseconds.
    PowerLoss,
}

/// Writes a file, with mode 0600, under a temporary name and then renames it, so that it is never incomplete.
pub fn write(path: &Path, bytes: &[u8], durability: Durability) -> Result<(), FileError> {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    // Makes the temporary name unique, because several threads of a process may write the same file.
    let n = N_PARTS.fetch_add(1, Ordering::Relaxed);
    name.push(format!(".{}-{n}{PART}", std::process::id()));
    let part = path.with_file_name(name);
    may_be_replaced(path).map_err(|error| failed(path, error))?;
    let written = create(&part).and_then(|mut file| {
        file.write_all(bytes)?;
        if durability == Durability::Kill {
            return std::fs::rename(&part, path);
        }
        file.sync_data()?;
        std::fs::rename(&part, path)?;
        sync_folder_of(path)
    });
    written.map_err(|error| {
        let _ = std::fs::remove_file(&part);
        failed(path, error)
    })
}

/// Waits until the folder's entries are on disk, so that the new file name survives a loss of power.
fn sync_folder_of(path: &Path) -> io::Result<()> {
    let folder = path
        .parent()
        .filter(|folder| !folder.as_os_str().is_empty());
    // Only Unix can open folders.
    if cfg!(unix) {
        File::open(folder.unwrap_or(Path::new(".")))?.sync_all()?;
    }
    Ok(())
}

pub fn read(path: &Path) -> Result<Snapshot, FileError> {
    let bytes = read_bytes(path).map_err(|error| failed(path, error))?;
    let snapshot = bytes.and_then(|bytes| decode(&bytes));
    snapshot.map_err(|error| refused(path, error))
}

pub fn refused(path: &Path, error: SnapshotError) -> FileError {
    FileError {
        path: path.display().to_string(),
        problem: error.to_string(),
        is_damaged: matches!(error, SnapshotError::Damaged(_)),
    }
}

/// Creates a new file. Removes whatever already has this name, such as a link or a pipe, without opening it.
pub(super) fn create(path: &Path) -> io::Result<File> {
    match std::fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    let mut options = OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    options.mode(0o600);
    options.open(path)
}

/// Checks that either nothing or a snapshot exists at the path. Other files, devices and links must not be replaced.
fn may_be_replaced(path: &Path) -> io::Result<()> {
    if path.file_name().is_none() {
        return Err(io::Error::other(NOT_A_FILE));
    }
    match path.symlink_metadata() {
        Err(_) => Ok(()),
        Ok(old) if !old.is_file() => Err(io::Error::other(NOT_A_FILE)),
        Ok(_) => {
            let mut magic = [0; MAGIC.len()];
            let _ = open(path)?.read(&mut magic)?;
            if magic == MAGIC {
                Ok(())
            } else {
                Err(io::Error::other(
                    "expected a new file or a snapshot to replace, got another kind of file",
                ))
            }
        }
    }
}

fn open(path: &Path) -> io::Result<File> {
    let mut options = OpenOptions::new();
    options.read(true);
    // Without this flag, opening a pipe would block until another process opens it for writing.
    #[cfg(unix)]
    options.custom_flags(rustix::fs::OFlags::NONBLOCK.bits() as i32);
    options.open(path)
}

/// Reads a whole file. First checks that it is a regular file, because reading a pipe could block and a device might
/// never end, and that its length is the one stated in its header.
fn read_bytes(path: &Path) -> io::Result<Result<Vec<u8>, SnapshotError>> {
    let mut file = open(path)?;
    let metadata = file.metadata()?;
    if !metadata.is_file() {
        return Err(io::Error::other(NOT_A_FILE));
    }
    let mut bytes = Vec::new();
    let mut header = Read::by_ref(&mut file).take(HEADER_BYTES as u64);
    header.read_to_end(&mut bytes)?;
    if let Err(error) = checked_length(&bytes, metadata.len().saturating_sub(HEADER_BYTES as u64)) {
        return Ok(Err(error));
    }
    file.take(MAX_BYTES).read_to_end(&mut bytes)?;
    Ok(Ok(bytes))
}

pub(super) fn failed(path: &Path, error: io::Error) -> FileError {
    FileError {
        path: path.display().to_string(),
        problem: error.to_string(),
        is_damaged: false,
    }
}
