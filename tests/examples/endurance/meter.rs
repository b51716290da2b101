//! What a process uses.

use std::path::{Path, PathBuf};

/// Memory, descriptors and shared memory at one moment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Use {
    /// Resident memory of the server, KiB.
    pub resident: u64,
    /// Its open descriptors.
    pub descriptors: usize,
    /// Files of this user's channels, of all instances.
    pub files: usize,
    /// KiB of those that are in use.
    pub shared: u64,
}

impl Use {
    /// That of a server.
    pub fn of(pid: u32) -> Self {
        let status = std::fs::read_to_string(format!("/proc/{pid}/status")).expect("its status");
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
        let number = line.and_then(|line| line.split_whitespace().next()?.parse().ok());
        let own = format!("/dev/shm/emberwatch-{}", rustix::process::getuid().as_raw());
        let is_own = |path: &PathBuf| {
            let path = path.to_string_lossy();
            let rest = path.strip_prefix(&own);
            rest.is_some_and(|rest| rest.starts_with(['_', '/']))
        };
        let mut files = files_under(Path::new("/dev/shm"));
        files.retain(is_own);
        Self {
            resident: number.expect("a number of KiB"),
            descriptors: std::fs::read_dir(format!("/proc/{pid}/fd"))
                .expect("its descriptors")
                .count(),
            files: files.len(),
            shared: files.iter().map(|path| kibibytes(path)).sum(),
        }
    }
}

impl std::fmt::Display for Use {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self {
            resident,
            descriptors,
            files,
            shared,
        } = self;
        write!(
            f,
            "{resident} KiB resident, {descriptors} descriptors, {files} channel files, {shared} KiB shared"
        )
    }
}

/// The files below a folder.
fn files_under(folder: &Path) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(folder) else {
        return Vec::new();
    };
    let paths = entries.flatten().map(|entry| entry.path());
    paths
        .flat_map(|path| match path.is_dir() {
            true => files_under(&path),
            false => vec![path],
        })
        .collect()
}

/// What a file really takes.
fn kibibytes(path: &Path) -> u64 {
    use std::os::unix::fs::MetadataExt;
    path.metadata().map_or(0, |metadata| metadata.blocks() / 2)
}
