//! Errors for threads that the system does not start. Each error names the limit that was reached.

use super::cgroups::{self, Controller};
use super::memory;
use std::error::Error;
use std::io::ErrorKind;
use std::path::Path;
use std::thread::{Builder, JoinHandle};

const CGROUP: Controller = Controller {
    name: "pids",
    limit: ["pids.max"; 2],
    used: ["pids.current"; 2],
    reclaimable: [&[]; 2],
};

/// Address space of a thread in bytes: its stack of 2 MiB, and the C library's data for it.
const THREAD_BYTES: u64 = 4 << 20;

/// The advice if the container forbids `clone3` in a way that prevents the C library from falling back to another call.
const REFUSED: &str = "the seccomp profile of the container forbids `clone3`; allow it, or let it fail with ENOSYS (Docker \
                       does since 20.10.10; --security-opt seccomp=PROFILE)";

#[derive(Debug, thiserror::Error)]
#[error("threads: expected to start {n_threads}, got: {problem}; {reason}")]
pub struct NoThreads {
    n_threads: usize,
    problem: String,
    reason: String,
}

/// Starts a thread with this name.
///
/// # Errors
/// If the system does not start the thread.
pub fn spawn<T: Send + 'static>(
    name: &str,
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<JoinHandle<T>, NoThreads> {
    let started = Builder::new().name(name.into()).spawn(work);
    started.map_err(|error| NoThreads::new(1, &error))
}

impl NoThreads {
    /// Makes the error for `n_threads` threads that could not be started. Looks for the limit that was reached.
    pub fn new(n_threads: usize, error: &(dyn Error + 'static)) -> Self {
        // The error of a thread pool wraps the system's error.
        let error = error.source().unwrap_or(error);
        let kind = error.downcast_ref().map(std::io::Error::kind);
        Self {
            n_threads,
            problem: error.to_string(),
            reason: match kind {
                Some(ErrorKind::PermissionDenied) => REFUSED.into(),
                _ => reason(Path::new("/"), n_threads as u64),
            },
        }
    }
}

fn reason(root: &Path, n_threads: u64) -> String {
    let of_stacks = format!("the stacks of {n_threads} threads");
    if let Err(short) = memory::check(of_stacks, n_threads.saturating_mul(THREAD_BYTES)) {
        return short.to_string();
    }
    let groups = cgroups::limits(root, &CGROUP).into_iter();
    if let Some(it) = groups
        .min_by_key(|it| it.free)
        .filter(|it| it.free < n_threads)
    {
        let (limit, free, file) = (it.limit, it.free, it.file.display());
        return format!(
            "a cgroup allows {limit} processes and threads, and {free} more can start ({file}); allow more (docker: \
             --pids-limit; systemd: TasksMax)"
        );
    }
    match limit_of_user() {
        Some(limit) => format!(
            "this user may have {limit} processes and threads (RLIMIT_NPROC); raise the limit (`ulimit -u`; docker: \
             --ulimit nproc), or end some"
        ),
        None => {
            "the system allows no more (kernel.threads-max, kernel.pid_max); end some processes"
                .into()
        }
    }
}

/// Returns the number of processes and threads that this user may have, if the system limits it.
#[cfg(target_os = "linux")]
fn limit_of_user() -> Option<u64> {
    use rustix::process::{Resource, getrlimit, getuid};
    let limit = getrlimit(Resource::Nproc).current;
    limit.filter(|_| !getuid().is_root())
}

#[cfg(not(target_os = "linux"))]
fn limit_of_user() -> Option<u64> {
    None
}
