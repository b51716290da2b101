//! What every program does when it starts: log to standard error, read settings and models, stop on signals or
//! with another process.

use crate::wait::is_readable;
use rustix::io::Errno;
use rustix::process::{Pid, PidfdFlags, pidfd_open};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use std::fs::File;
use std::io::{IsTerminal, Read};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use thiserror::Error;
use tracing_subscriber::EnvFilter;

/// Longest settings or model file, bytes: a model of 64 states with kernels of 15 x 15 cells has 5 MB.
pub const MAX_TEXT_BYTES: u64 = 16 << 20;

/// The process that a private program ends with.
#[derive(Debug)]
pub struct Keeper(OwnedFd);

/// The process to end with is not there.
#[derive(Debug, Error, PartialEq, Eq)]
#[error("--exit-with {pid}: expected a running process, got {problem}")]
pub struct NoKeeper {
    pid: i32,
    problem: String,
}

impl Keeper {
    /// Watches a process.
    ///
    /// # Errors
    /// [`NoKeeper`] if it is not there.
    pub fn watch(pid: i32) -> Result<Self, NoKeeper> {
        let open = |process| pidfd_open(process, PidfdFlags::empty());
        let process = (pid > 0).then(|| Pid::from_raw(pid)).flatten();
        let descriptor = process.ok_or(Errno::SRCH).and_then(open);
        descriptor.map(Self).map_err(|errno| NoKeeper {
            pid,
            problem: errno.to_string(),
        })
    }

    /// Readable when it has ended.
    pub fn descriptor(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }

    /// Whether it has ended.
    pub fn has_ended(&self) -> bool {
        is_readable(self.descriptor())
    }
}

/// A process's state, such as `R` or `Z`, as `/proc` says; `None` if there is none of that id.
pub(crate) fn process_state(pid: i32) -> Option<char> {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // After its name, which may hold anything, in brackets.
    stat.rsplit_once(") ")?.1.chars().next()
}

/// Logs to standard error, at `info` unless `RUST_LOG` says otherwise.
pub fn start_logging() {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info"));
    let log = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr);
    log.with_target(false)
        .with_ansi(std::io::stderr().is_terminal())
        .init();
}

/// The text of a settings or model file, which may be a pipe but not endless.
///
/// # Errors
/// The system's, or what is wrong with the text.
pub fn read_text(path: &Path) -> std::io::Result<String> {
    let mut text = String::new();
    let mut file = File::open(path)?.take(MAX_TEXT_BYTES + 1);
    if file.read_to_string(&mut text)? as u64 > MAX_TEXT_BYTES {
        let problem = format!("expected at most {MAX_TEXT_BYTES} bytes, got more");
        return Err(std::io::Error::other(problem));
    }
    Ok(text)
}

/// A flag that SIGINT, SIGTERM or SIGHUP sets; a second one ends the process at once.
///
/// # Errors
/// The system's, when it lets no handler be installed.
pub fn stop_on_signals() -> std::io::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM, SIGHUP] {
        signal_hook::flag::register_conditional_shutdown(signal, 1, stop.clone())?;
        signal_hook::flag::register(signal, stop.clone())?;
    }
    Ok(stop)
}
