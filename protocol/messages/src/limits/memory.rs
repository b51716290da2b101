//! Checks the memory that this process can still allocate, and rejects larger requests before anything is allocated.

use super::cgroups::{self, Controller};
#[cfg(target_os = "linux")]
use rustix::process::{Resource, getrlimit};
use std::fmt::Display;
use std::path::Path;
use thiserror::Error;

const CGROUP: Controller = Controller {
    name: "memory",
    limit: ["memory.limit_in_bytes", "memory.max"],
    used: ["memory.usage_in_bytes", "memory.current"],
    reclaimable: [
        &["total_inactive_file", "total_active_file"],
        &["inactive_file", "active_file"],
    ],
};

#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("memory: expected {} for {what}, got {got}", in_words(*.needed))]
pub struct NoMemory {
    what: String,
    needed: u64,
    got: String,
}

#[derive(Debug, PartialEq, Eq)]
struct Limit {
    free: u64,
    words: String,
}

/// Checks that this process can allocate `n_bytes` for `what`.
///
/// # Errors
/// If the machine, a cgroup or a `ulimit` has less memory.
pub fn check(what: impl Display, n_bytes: u64) -> Result<(), NoMemory> {
    check_below(Path::new("/"), &what, n_bytes)?;
    // Some limits appear in no file, such as the limit on overcommitted memory.
    let mut probe = Vec::<u8>::new();
    let reserved = usize::try_from(n_bytes).map(|n_bytes| probe.try_reserve_exact(n_bytes));
    match reserved {
        Ok(Ok(())) => Ok(()),
        _ => Err(refused(what, n_bytes)),
    }
}

pub fn refused(what: impl Display, n_bytes: u64) -> NoMemory {
    let none = |_| NoMemory {
        what: what.to_string(),
        needed: n_bytes,
        got: "a refusal of the system (see vm.overcommit_memory)".into(),
    };
    check_below(Path::new("/"), &what, n_bytes).map_or_else(|error| error, none)
}

/// Allocates an empty vector whose capacity depends on external input.
///
/// # Errors
/// If there is not enough memory.
pub fn with_capacity<T>(what: impl Display, capacity: usize) -> Result<Vec<T>, NoMemory> {
    let mut empty = Vec::new();
    let n_bytes = capacity.saturating_mul(size_of::<T>()) as u64;
    match empty.try_reserve_exact(capacity) {
        Ok(()) => Ok(empty),
        Err(_) => Err(refused(what, n_bytes)),
    }
}

fn check_below(root: &Path, what: &impl Display, needed: u64) -> Result<(), NoMemory> {
    let limits = limits(root).into_iter();
    let tightest = limits.min_by_key(|limit| limit.free);
    let short = tightest.filter(|limit| limit.free < needed);
    short.map_or(Ok(()), |limit| {
        let (what, got) = (
            what.to_string(),
            format!("{} {}", in_words(limit.free), limit.words),
        );
        Err(NoMemory { what, needed, got })
    })
}

fn limits(root: &Path) -> Vec<Limit> {
    let of_cgroup = |it: cgroups::CgroupLimit| Limit {
        free: it.free,
        words: format!(
            "left of {}, the limit of a cgroup ({}); give the container more (docker: --memory; Kubernetes: \
             resources.limits.memory)",
            in_words(it.limit),
            it.file.display()
        ),
    };
    let groups = cgroups::limits(root, &CGROUP).into_iter().map(of_cgroup);
    groups
        .chain(of_machine(root))
        .chain(of_process(root))
        .collect()
}

fn of_machine(root: &Path) -> Option<Limit> {
    let text = std::fs::read_to_string(root.join("proc/meminfo")).ok()?;
    Some(Limit {
        free: kib(&text, "MemAvailable:")?,
        words: format!(
            "available of {}, the machine's memory",
            in_words(kib(&text, "MemTotal:")?)
        ),
    })
}

/// Returns no limits, because the limits of `ulimit`, cgroups and `/proc` are unknown outside Linux.
#[cfg(not(target_os = "linux"))]
fn of_process(_root: &Path) -> Vec<Limit> {
    Vec::new()
}

#[cfg(target_os = "linux")]
fn of_process(root: &Path) -> Vec<Limit> {
    let text = std::fs::read_to_string(root.join("proc/self/status")).unwrap_or_default();
    let limit = |(resource, name, flag, used)| {
        let limit = getrlimit(resource).current?;
        Some(Limit {
            free: limit.saturating_sub(kib(&text, used)?),
            words: format!(
                "left of {}, the limit {name}; raise it (`ulimit {flag}`)",
                in_words(limit)
            ),
        })
    };
    let kinds = [
        (Resource::As, "RLIMIT_AS", "-v", "VmSize:"),
        (Resource::Data, "RLIMIT_DATA", "-d", "VmData:"),
    ];
    kinds.into_iter().filter_map(limit).collect()
}

/// Parses the number of bytes from a line such as `MemTotal:  1024 kB`.
fn kib(text: &str, name: &str) -> Option<u64> {
    let line = text.lines().find_map(|line| line.strip_prefix(name))?;
    let number = line.trim().strip_suffix(" kB")?.parse::<u64>().ok()?;
    number.checked_mul(1 << 10)
}

/// Formats a number of bytes, rounded up to the next KiB or MiB.
pub fn in_words(n_bytes: u64) -> String {
    match n_bytes >> 20 {
        0..10 => format!("{} KiB", n_bytes.div_ceil(1 << 10)),
        _ => format!("{} MiB", n_bytes.div_ceil(1 << 20)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refusal_for_too_much_memory_states_the_numbers() {
        let check_refused = |error: String, expected: &str| {
            assert!(error.starts_with(expected), "{error}");
        };
        let expected = "memory: expected 1073741824 MiB for worlds, got ";
        let refused = check("worlds", 1 << 50).expect_err("too much");
        check_refused(refused.to_string(), expected);
        let refused = with_capacity::<u64>("numbers", 1 << 47).expect_err("too many");
        check_refused(refused.to_string(), "memory: expected 1073741824 MiB");
        check("worlds", 1 << 20).expect("enough");
        let made = with_capacity::<u8>("bytes", 7).map(|it| it.capacity());
        assert_eq!(made, Ok(7));
    }

    #[test]
    fn a_number_of_kib_is_read_by_its_name() {
        let text = "MemTotal:       16 kB\nMemAvailable:   4 kB\n";
        assert_eq!(kib(text, "MemAvailable:"), Some(4096));
        assert_eq!(kib(text, "MemFree:"), None);
    }
}
