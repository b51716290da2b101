//! Instances whose name is in use by another server or still blocked by a dead one.
//!
//! Removing the files of a dead process requires a lock (`emberwatch_protocol::turn`), for which a process may have to
//! wait. Until the files are removed, the dead process appears to own the instance.

use anyhow::Result;
use emberwatch_protocol::program::WatchedProcess;
use rustix::io::Errno;
use std::time::{Duration, Instant};
use thiserror::Error;

/// How long to retry while a dead process owns the instance.
const LIMIT: Duration = Duration::from_secs(10);

const INTERVAL: Duration = Duration::from_millis(100);

#[derive(Debug, Error)]
#[error("instance {instance:?} is already running, as pid {pid}")]
pub struct Taken {
    pub instance: String,
    pub pid: i32,
}

impl Taken {
    fn is_left_over(&self) -> bool {
        match WatchedProcess::open(self.pid) {
            Ok(process) => process.has_ended(),
            // Only this error means that the process has ended.
            Err(errno) => errno == Errno::SRCH,
        }
    }
}

/// Calls `open`, and repeats the call while the instance belongs to a dead process.
pub fn once_free<T>(mut open: impl FnMut() -> Result<T>) -> Result<T> {
    let start = Instant::now();
    loop {
        let opened = open();
        let owner = opened.as_ref().err().and_then(|error| error.downcast_ref());
        if !owner.is_some_and(Taken::is_left_over) || start.elapsed() > LIMIT {
            return opened;
        }
        std::thread::sleep(INTERVAL);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::process::Command;

    /// Opens an instance that appears to belong to process `pid` at the first attempt. Returns the number of attempts.
    fn tries(pid: u32) -> usize {
        let mut n_tries = 0;
        let opened = once_free(|| {
            n_tries += 1;
            let (instance, pid) = ("lab".into(), pid as i32);
            match n_tries {
                1 => Err(Taken { instance, pid }.into()),
                _ => Ok(()),
            }
        });
        assert_eq!(opened.is_ok(), n_tries == 2);
        n_tries
    }

    #[test]
    fn opening_is_retried_while_a_dead_process_owns_the_instance() {
        let mut child = Command::new("true").spawn().expect("a process");
        child.wait().expect("its end");
        assert_eq!(tries(child.id()), 2);
        assert_eq!(tries(std::process::id()), 1);
    }
}
