//! Snapshot files: written whole or not at all, and a folder of an instance's last ones.

use super::{HEADER_BYTES, MAGIC, MAX_BYTES, Snapshot, SnapshotError, checked_length, decode};
use protocol::channels::Instance;
use rustix::fs::OFlags;
use std::fs::{File, OpenOptions};
use std::io::{self, Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use thiserror::Error;

/// Digits of a file's number.
const DIGITS: usize = 12;

/// What is wrong with pipes, devices, folders and links.
const NOT_A_FILE: &str = "expected a regular file, got something else";

/// How the name of a file ends that is being written.
const PART: &str = ".part";

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

/// What a file that was just written stays whole after.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outlives {
    /// The death of any process.
    Kills,
    /// A loss of power, too: the disk has it. Takes some milliseconds.
    PowerLoss,
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
            .and_then(|_| std::fs::remove_file(&probe))
            .and_then(|()| self.tidy_up());
        made.map_err(|error| failed(&self.path, error))
    }

    /// The refusal to write where another run's files are, which would be replaced one by one.
    pub fn not_empty(&self, n_files: usize) -> FileError {
        let instance = &self.instance;
        FileError {
            path: self.path.display().to_string(),
            problem: format!(
                "expected none of instance {instance:?}, or --restore, got {n_files} of another run"
            ),
            is_damaged: false,
        }
    }

    /// Removes what a server that was killed had begun to write.
    fn tidy_up(&self) -> io::Result<()> {
        for entry in std::fs::read_dir(&self.path)?.flatten() {
            let name = entry.file_name();
            let name = name.to_string_lossy();
            let is_own = name
                .strip_prefix(&*self.instance)
                .is_some_and(|rest| rest.starts_with('-'));
            if is_own && name.ends_with(PART) {
                std::fs::remove_file(entry.path())?;
            }
        }
        Ok(())
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
            let number = number.strip_suffix(EXTENSION)?.strip_suffix('.')?;
            (number.len() == DIGITS).then(|| number.parse().ok())?
        };
        let paths = entries.flatten().map(|entry| entry.path());
        let mut files: Vec<(u64, PathBuf)> = paths
            .filter_map(|path| Some((number(&path)?, path)))
            .collect();
        files.sort_unstable();
        Ok(files)
    }

    /// How the instance's files are named.
    pub fn pattern(&self) -> String {
        format!("{}-<{DIGITS} digits>.{EXTENSION}", self.instance)
    }

    /// The names of the folder's snapshots of all instances, by their ending.
    pub fn snapshots(&self) -> Vec<String> {
        let entries = std::fs::read_dir(&self.path)
            .into_iter()
            .flatten()
            .flatten();
        let paths = entries.map(|entry| entry.path());
        let mut names: Vec<String> = paths
            .filter(|path| path.extension().is_some_and(|end| end == EXTENSION))
            .filter_map(|path| Some(path.file_name()?.to_string_lossy().into_owned()))
            .collect();
        names.sort_unstable();
        names
    }

    /// Writes the next file and removes all but the last few and `spared`.
    ///
    /// # Errors
    /// [`FileError`].
    pub fn save(
        &self,
        bytes: &[u8],
        outlives: Outlives,
        keep: usize,
        spared: Option<&Path>,
    ) -> Result<PathBuf, FileError> {
        let files = self.files()?;
        let number = files.last().map_or(1, |(number, _)| number + 1);
        let name = format!("{}-{number:0DIGITS$}.{EXTENSION}", self.instance);
        let path = self.path.join(name);
        write(&path, bytes, outlives)?;
        let n_surplus = (files.len() + 1).saturating_sub(keep);
        let surplus = files[..n_surplus].iter().map(|(_, old)| old);
        for old in surplus.filter(|old| Some(old.as_path()) != spared) {
            let _ = std::fs::remove_file(old); // Somebody else may have tidied up.
        }
        Ok(path)
    }
}

/// Writes a file by way of another name, so that there is never half of it; mode 0600.
///
/// # Errors
/// [`FileError`].
pub fn write(path: &Path, bytes: &[u8], outlives: Outlives) -> Result<(), FileError> {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(format!(".{}{PART}", std::process::id()));
    let part = path.with_file_name(name);
    may_be_replaced(path).map_err(|error| failed(path, error))?;
    let written = create(&part).and_then(|mut file| {
        file.write_all(bytes)?;
        if outlives == Outlives::Kills {
            return std::fs::rename(&part, path);
        }
        file.sync_data()?;
        std::fs::rename(&part, path)?;
        // So that the new name outlives it, too.
        let folder = path
            .parent()
            .filter(|folder| !folder.as_os_str().is_empty());
        File::open(folder.unwrap_or(Path::new(".")))?.sync_all()
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
    let snapshot = bytes.and_then(|bytes| decode(&bytes));
    snapshot.map_err(|error| refused(path, error))
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

/// A new file; what has its name, a link or a pipe perhaps, is removed and not opened.
fn create(path: &Path) -> io::Result<File> {
    match std::fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    let mut options = OpenOptions::new();
    options.write(true).create_new(true).mode(0o600);
    options.open(path)
}

/// Only a snapshot gives way to a snapshot: no other file, no device, nothing that a link points to.
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
            match magic == MAGIC {
                true => Ok(()),
                false => Err(io::Error::other(
                    "expected no file or a snapshot to replace, got another kind of file",
                )),
            }
        }
    }
}

fn open(path: &Path) -> io::Result<File> {
    let flags = OFlags::NONBLOCK.bits() as i32;
    OpenOptions::new().read(true).custom_flags(flags).open(path)
}

/// All of a regular file whose header fits it: a pipe would block, and a device might never end.
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

fn failed(path: &Path, error: io::Error) -> FileError {
    FileError {
        path: path.display().to_string(),
        problem: error.to_string(),
        is_damaged: false,
    }
}
