//! The folder of an instance's latest snapshot files.

use super::file::{Durability, FileError, PART, create, failed, write};
use emberwatch_messages::instance::Instance;
use std::io;
use std::path::{Path, PathBuf};

const DIGITS: usize = 12;

const EXTENSION: &str = "snapshot";

/// A folder that contains the latest snapshots of an instance as numbered files.
#[derive(Debug, Clone)]
pub struct Folder {
    path: PathBuf,
    instance: String,
}

impl Folder {
    pub fn new(path: &Path, instance: &Instance) -> Self {
        Self {
            path: path.into(),
            instance: instance.name().into(),
        }
    }

    /// Creates the folder, checks that files can be created in it, and removes unfinished files.
    pub fn prepare(&self) -> Result<(), FileError> {
        let probe = self.path.join(format!(".{}.probe", self.instance));
        let made = std::fs::create_dir_all(&self.path)
            .and_then(|()| create(&probe))
            .and_then(|_| std::fs::remove_file(&probe))
            .and_then(|()| self.remove_parts());
        made.map_err(|error| failed(&self.path, error))
    }

    /// Creates the error for a folder that contains snapshots of an earlier run. A new run would gradually replace
    /// them.
    pub fn not_empty(&self, n_files: usize) -> FileError {
        let instance = &self.instance;
        FileError {
            path: self.path.display().to_string(),
            problem: format!(
                "expected no snapshots of instance {instance:?}, got {n_files} of an earlier run: continue it with \
                 --restore, or choose another folder"
            ),
            is_damaged: false,
        }
    }

    fn remove_parts(&self) -> io::Result<()> {
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

    /// Returns the numbers and paths of the instance's files, the oldest first.
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

    pub fn pattern(&self) -> String {
        format!("{}-<{DIGITS} digits>.{EXTENSION}", self.instance)
    }

    /// Returns the names of the folder's snapshots of all instances, sorted.
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

    /// Writes the next file. Then removes all files except `also_keep` and the latest `keep` files (the new file is one
    /// of these).
    pub fn save(
        &self,
        bytes: &[u8],
        durability: Durability,
        keep: usize,
        also_keep: Option<&Path>,
    ) -> Result<PathBuf, FileError> {
        let files = self.files()?;
        let number = files.last().map_or(1, |(number, _)| number + 1);
        let name = format!("{}-{number:0DIGITS$}.{EXTENSION}", self.instance);
        let path = self.path.join(name);
        write(&path, bytes, durability)?;
        let n_old = (files.len() + 1).saturating_sub(keep);
        let old_files = files[..n_old].iter().map(|(_, old)| old);
        for old in old_files.filter(|old| Some(old.as_path()) != also_keep) {
            let _ = std::fs::remove_file(old); // The file may have been removed already.
        }
        Ok(path)
    }
}
