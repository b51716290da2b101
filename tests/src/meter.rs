//! Measures the resources that a process uses.

use std::path::{Path, PathBuf};

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
