//! Other processes: checks whether they run, and watches for their end.

use super::poll::is_readable;
use super::resources::call_error;
use emberwatch_messages::errors::ChannelError;
use rustix::fs::{major, minor};
use rustix::io::Errno;
use rustix::process::{Pid, PidfdFlags, getpid, pidfd_open};
use std::io::{Error, ErrorKind};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};

#[derive(Debug)]
pub struct WatchedProcess(OwnedFd);

#[derive(Debug, thiserror::Error)]
pub enum NotWatched {
    #[error("--exit-with {pid}: expected a running process, got none with this id")]
    NotRunning { pid: i32 },
    #[error("--exit-with {pid}: {problem}")]
    Refused { pid: i32, problem: ChannelError },
}

impl WatchedProcess {
    /// Watches a process.
    ///
    /// # Errors
    /// `ESRCH` if there is no such process, or the system's error if no file descriptor is available.
    pub fn open(pid: i32) -> Result<Self, Errno> {
        let process = (pid > 0).then(|| Pid::from_raw(pid)).flatten();
        pidfd_open(process.ok_or(Errno::SRCH)?, PidfdFlags::empty()).map(Self)
    }

    /// Watches the process that `--exit-with` names.
    ///
    /// # Errors
    /// If the process does not run, or the system does not allow watching it.
    pub fn watch(pid: i32) -> Result<Self, NotWatched> {
        Self::open(pid).map_err(|errno| match errno {
            Errno::SRCH | Errno::INVAL => NotWatched::NotRunning { pid },
            errno => NotWatched::Refused {
                pid,
                problem: watch_error(errno),
            },
        })
    }

    /// Checks that this process may watch others. Otherwise it could not notice their deaths.
    ///
    /// # Errors
    /// If the system does not allow it.
    pub fn check() -> Result<(), ChannelError> {
        Self::open(getpid().as_raw_nonzero().get())
            .map(drop)
            .map_err(watch_error)
    }

    pub fn descriptor(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }

    pub fn has_ended(&self) -> bool {
        is_readable(self.descriptor())
    }
}

pub(super) fn watch_error(errno: Errno) -> ChannelError {
    call_error("pidfd_open", errno)
}

/// Returns the process of an iceoryx2 node or port from its id. The process id is valid in that process's PID
/// namespace.
pub fn node_pid(id: u128) -> i32 {
    (id >> 64) as i32
}

/// Returns a process's state in `/proc`, such as `R` or `Z`, or `None` if there is no such process.
pub(crate) fn process_state(pid: i32) -> Result<Option<char>, Error> {
    let stat = if_there(std::fs::read_to_string(format!("/proc/{pid}/stat")))?;
    // The state follows the name, which is in brackets and may itself contain brackets.
    Ok(stat.and_then(|stat| stat.rsplit_once(") ")?.1.chars().next()))
}

/// Returns the process that has a lock for writing on a file, from `/proc/locks`. `kind` is `FLOCK`, or `POSIX` for a
/// lock of `fcntl`.
pub(super) fn lock_holder(kind: &str, device: u64, inode: u64) -> Option<i32> {
    let (major, minor) = (major(device), minor(device));
    let file = format!("{major:02x}:{minor:02x}:{inode}");
    let locks = std::fs::read_to_string("/proc/locks").ok()?;
    // "1: FLOCK  ADVISORY  WRITE 4711 00:1a:5678 0 EOF"; a line of a waiting process begins with an arrow.
    locks.lines().find_map(|line| {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words[..] {
            [_, found, _, "WRITE", pid, of, ..] if found == kind && of == file => pid.parse().ok(),
            _ => None,
        }
    })
}

/// Returns the result of reading a file, or `None` if the file does not exist. Other errors are returned, because they
/// do not prove that the file is missing.
pub(crate) fn if_there<T>(read: Result<T, Error>) -> Result<Option<T>, Error> {
    match read {
        Ok(found) => Ok(Some(found)),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        // The process ended after its file in `/proc` was opened.
        Err(error) if error.raw_os_error() == Some(Errno::SRCH.raw_os_error()) => Ok(None),
        Err(error) => Err(error),
    }
}
