//! Measures the resources that a process uses.

use emberwatch_protocol::channels::SHARED_MEMORY;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

/// The memory, descriptors and shared memory in use at one moment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Use {
    /// Resident memory of the process, in KiB.
    pub resident: u64,
    pub descriptors: usize,
    /// Number of files of this user's channels, for all instances.
    pub files: usize,
    /// Disk blocks that these files occupy, in KiB.
    pub shared: u64,
}

impl Use {
    /// Measures a process.
    pub fn of(pid: u32) -> Self {
        let user = rustix::process::getuid().as_raw();
        let own = format!("{SHARED_MEMORY}/emberwatch-{user}");
        let is_own = |path: &PathBuf| {
            let path = path.to_string_lossy();
            let rest = path.strip_prefix(&own);
            rest.is_some_and(|rest| rest.starts_with(['_', '/']))
        };
        let mut files = all_under(Path::new(SHARED_MEMORY));
        files.retain(|path| is_own(path) && !path.is_dir());
        // The number of allocated blocks of a file. A block has 512 bytes.
        let blocks = |path: &PathBuf| path.metadata().map_or(0, |file| file.blocks());
        Self {
            resident: memory("VmRSS:", pid),
            descriptors: n_descriptors(pid),
            files: files.len(),
            shared: files.iter().map(|path| blocks(path) / 2).sum(),
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

/// Parses the value, in KiB, from the line of `/proc/<pid>/status` that begins with `line`. Returns 0 if there is no
/// such line.
pub fn memory(line: &str, pid: u32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let found = status.lines().find_map(|text| text.strip_prefix(line));
    found
        .and_then(|text| text.split_whitespace().next()?.parse().ok())
        .unwrap_or(0)
}

pub fn n_descriptors(pid: u32) -> usize {
    let descriptors = std::fs::read_dir(format!("/proc/{pid}/fd"));
    descriptors.expect("its descriptors").count()
}

/// Returns the user and system time of a process, in seconds. The kernel counts hundredths of a second.
pub fn processor_seconds(pid: u32) -> f64 {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).expect("a running process");
    let (_, after_name) = stat.rsplit_once(')').expect("its name in brackets");
    let fields: Vec<&str> = after_name.split_whitespace().collect();
    let ticks = |at: usize| fields[at].parse::<f64>().expect("a number");
    (ticks(11) + ticks(12)) / 100.0
}

/// Returns a folder and everything below it.
pub fn all_under(folder: &Path) -> Vec<PathBuf> {
    let mut all = vec![folder.to_path_buf()];
    let mut next = 0;
    while let Some(folder) = all.get(next).cloned() {
        let below = std::fs::read_dir(folder).into_iter().flatten().flatten();
        all.extend(below.map(|entry| entry.path()));
        next += 1;
    }
    all
}
