//! Snapshot files: written whole or not at all, and a folder of an instance's last ones.

use super::{MAX_BYTES, Snapshot, SnapshotError, decode};
use protocol::channels::Instance;
use rustix::fs::OFlags;
use std::fs::{File, OpenOptions};
use std::io::{self, Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use thiserror::Error;

/// What is wrong with pipes, devices, folders and links.
const NOT_A_FILE: &str = "expected a regular file, got something else";

/// How the files of a folder end.
const EXTENSION: &str = "snapshot";

/// A file that could not be written or is refused.
#[derive(Debug, Error)]
#[error("snapshot file {path}: {problem}")]
pub struct FileError {
    /// The file, or its folder.
    pub path: String,
    /// What is wrong.
    pub problem: String,
    /// Whether another file may do: this one is damaged.
    pub is_damaged: bool,
}

/// A folder with the last snapshots of an instance, numbered.
#[derive(Debug, Clone)]
pub struct Folder {
    path: PathBuf,
    instance: String,
}

impl Folder {
    /// The folder's files of an instance; nothing is looked at yet.
    pub fn new(path: &Path, instance: &Instance) -> Self {
        Self {
            path: path.into(),
            instance: instance.name().into(),
        }
    }

    /// Makes the folder and checks that files can be made in it.
    ///
    /// # Errors
    /// [`FileError`].
    pub fn prepare(&self) -> Result<(), FileError> {
        let probe = self.path.join(format!(".{}.probe", self.instance));
        let made = std::fs::create_dir_all(&self.path)
            .and_then(|()| create(&probe))
            .and_then(|_| std::fs::remove_file(&probe));
        made.map_err(|error| failed(&self.path, error))
    }

    /// The instance's files, the oldest first.
    ///
    /// # Errors
    /// [`FileError`] if the folder cannot be read.
    pub fn files(&self) -> Result<Vec<(u64, PathBuf)>, FileError> {
        let entries = std::fs::read_dir(&self.path).map_err(|error| failed(&self.path, error))?;
        let number = |path: &Path| {
            let name = path.file_name()?.to_str()?;
            let number = name.strip_prefix(&self.instance)?.strip_prefix('-')?;
            number
                .strip_suffix(EXTENSION)?
                .strip_suffix('.')?
                .parse()
                .ok()
        };
        let paths = entries.flatten().map(|entry| entry.path());
        let mut files: Vec<(u64, PathBuf)> = paths
            .filter_map(|path| Some((number(&path)?, path)))
            .collect();
        files.sort_unstable();
        Ok(files)
    }

    /// Writes the next file and removes all but the last few.
    ///
    /// # Errors
    /// [`FileError`].
    pub fn save(&self, bytes: &[u8], keep: usize) -> Result<PathBuf, FileError> {
        let files = self.files()?;
        let number = files.last().map_or(1, |(number, _)| number + 1);
        let name = format!("{}-{number:012}.{EXTENSION}", self.instance);
        let path = self.path.join(name);
        write(&path, bytes)?;
        let n_surplus = (files.len() + 1).saturating_sub(keep);
        for (_, old) in &files[..n_surplus] {
            let _ = std::fs::remove_file(old); // Somebody else may have tidied up.
        }
        Ok(path)
    }
}

/// Writes a file by way of another name, so that there is never half of it; mode 0600.
///
/// # Errors
/// [`FileError`].
pub fn write(path: &Path, bytes: &[u8]) -> Result<(), FileError> {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(format!(".{}.part", std::process::id()));
    let part = path.with_file_name(name);
    // Only a file gives way to a file: not a device, nor what a link points to.
    let is_other = path.symlink_metadata().is_ok_and(|old| !old.is_file());
    if is_other || path.file_name().is_none() {
        return Err(failed(path, io::Error::other(NOT_A_FILE)));
    }
    let written = create(&part).and_then(|mut file| {
        file.write_all(bytes)?;
        file.sync_data()?;
        std::fs::rename(&part, path)
    });
    written.map_err(|error| {
        let _ = std::fs::remove_file(&part);
        failed(path, error)
    })
}

/// Reads a snapshot file.
///
/// # Errors
/// [`FileError`].
pub fn read(path: &Path) -> Result<Snapshot, FileError> {
    let bytes = read_bytes(path).map_err(|error| failed(path, error))?;
    decode(&bytes).map_err(|error| refused(path, error))
}

/// The refusal of a file.
pub fn refused(path: &Path, error: SnapshotError) -> FileError {
    let is_damaged = matches!(
        error,
        SnapshotError::Foreign | SnapshotError::Length { .. } | SnapshotError::Checksum { .. }
    );
    FileError {
        path: path.display().to_string(),
        problem: error.to_string(),
        is_damaged,
    }
}

fn create(path: &Path) -> io::Result<File> {
    let mut options = OpenOptions::new();
    options.write(true).create(true).truncate(true).mode(0o600);
    options.open(path)
}

/// All of a regular file: a pipe would block, and a device might never end.
fn read_bytes(path: &Path) -> io::Result<Vec<u8>> {
    let mut options = OpenOptions::new();
    let flags = OFlags::NONBLOCK.bits() as i32;
    let file = options.read(true).custom_flags(flags).open(path)?;
    let metadata = file.metadata()?;
    if !metadata.is_file() {
        return Err(io::Error::other(NOT_A_FILE));
    }
    let mut bytes = Vec::with_capacity(metadata.len().min(MAX_BYTES) as usize);
    file.take(MAX_BYTES).read_to_end(&mut bytes)?;
    Ok(bytes)
}

fn failed(path: &Path, error: io::Error) -> FileError {
    FileError {
        path: path.display().to_string(),
        problem: error.to_string(),
        is_damaged: false,
    }
}
