//! A lock between processes. A *turn* is the time in which one process holds it; every process takes a turn before it
//! creates or removes nodes, services or ports (PROTOCOL.md section 1).
//!
//! During a turn no other process creates anything, so unfinished files were left by dead processes. The lock is a
//! `flock`, which ends with its process.

use super::directory::{not_usable, own_channel_directory};
use super::process::{lock_holder, process_state};
use super::resources::call_error;
use emberwatch_messages::errors::ChannelError;
use emberwatch_messages::interrupt::check_interrupt;
use rustix::fs::{FlockOperation, Mode, OFlags, flock, fstat, open, stat};
use rustix::io::Errno;
use std::cell::Cell;
use std::os::fd::OwnedFd;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Maximum wait for other processes, each of which holds the turn for milliseconds.
const LONGEST_WAIT: Duration = Duration::from_secs(10);

/// Maximum wait before closing and cleaning up, after which ports are closed without a turn, and cleaning up is left to
/// the next program.
const SHORT_WAIT: Duration = Duration::from_secs(1);

/// Time after which a waiting process checks which process has the turn, and whether it is stopped.
const STOPPED_WAIT: Duration = Duration::from_millis(50);

/// Time after which a process that has the turn counts as frozen. The system does not report frozen processes.
const FROZEN_WAIT: Duration = Duration::from_secs(2);

const INTERVAL: Duration = Duration::from_micros(500);

const LOCK: &str = "lock";

#[derive(Clone, Copy, PartialEq, Eq)]
enum Held {
    No,
    /// This thread has the lock: no other process creates or removes anything.
    Alone,
    /// A stopped process has the lock, and this thread continues without it.
    Unlocked,
}

/// Set while a thread of this process has a turn or forks. If a process forked during a turn, its child would inherit a
/// lock that no thread of the child unlocks. The flag is a polled atomic, because a mutex would not survive a fork.
static BUSY: AtomicBool = AtomicBool::new(false);

thread_local! {
    static HELD: Cell<Held> = const { Cell::new(Held::No) };
}

/// A turn, which ends when it is dropped. A turn within another turn of the same thread is part of the outer turn.
#[derive(Debug)]
pub struct Turn {
    is_outermost: bool,
    lock: Option<OwnedFd>,
}

/// Waits until no other thread has a turn, and blocks new turns. Call it before a fork.
pub fn before_fork() {
    if HELD.get() == Held::No {
        while BUSY.swap(true, Ordering::Acquire) {
            std::thread::sleep(INTERVAL);
        }
    }
}

/// Allows turns again. Call it after the fork, in the parent and in the child.
pub fn after_fork() {
    if HELD.get() == Held::No {
        BUSY.store(false, Ordering::Release);
    }
}

impl Turn {
    /// Waits for a turn. If a stopped or frozen process has the turn, continues without it.
    ///
    /// # Errors
    /// If other processes hold the lock for too long, or the directory is not writable.
    pub fn take() -> Result<Self, ChannelError> {
        Self::take_within(LONGEST_WAIT)
    }

    pub(crate) fn take_within(limit: Duration) -> Result<Self, ChannelError> {
        Self::take_unless(limit, check_interrupt)
    }

    /// Waits as [`Self::take`] does, but only briefly, and without checking for interrupts. It is for closing ports and
    /// cleaning up.
    pub(crate) fn take_to_end() -> Result<Self, ChannelError> {
        Self::take_unless(SHORT_WAIT, || Ok(()))
    }

    fn take_unless(
        limit: Duration,
        check: fn() -> Result<(), ChannelError>,
    ) -> Result<Self, ChannelError> {
        let is_outermost = HELD.get() == Held::No;
        let lock = if is_outermost {
            let path = own_channel_directory()?.join(LOCK);
            wait(&path, limit.min(LONGEST_WAIT), check)?
        } else {
            None
        };
        if is_outermost {
            before_fork();
            HELD.set(if lock.is_some() {
                Held::Alone
            } else {
                Held::Unlocked
            });
        }
        Ok(Self { is_outermost, lock })
    }

    /// Returns whether this thread has the lock, so that no other process creates or removes anything.
    pub fn is_alone(&self) -> bool {
        HELD.get() == Held::Alone
    }
}

impl Drop for Turn {
    fn drop(&mut self) {
        if let Some(lock) = &self.lock {
            // Closing the file is not enough, because the child of a fork may have a copy of the descriptor.
            let _ = flock(lock, FlockOperation::Unlock);
        }
        if self.is_outermost {
            HELD.set(Held::No);
            after_fork();
        }
    }
}

/// Waits for the lock. Returns `None` if a stopped or frozen process has it.
fn wait(
    path: &Path,
    limit: Duration,
    check: fn() -> Result<(), ChannelError>,
) -> Result<Option<OwnedFd>, ChannelError> {
    let start = Instant::now();
    let mut held_since = (None, start);
    let flags = OFlags::RDWR | OFlags::CREATE | OFlags::CLOEXEC;
    let wrong = |errno: Errno| not_usable(path, errno.into());
    loop {
        let file = open(path, flags, Mode::RUSR | Mode::WUSR).map_err(wrong)?;
        match flock(&file, FlockOperation::NonBlockingLockExclusive) {
            Ok(()) if is_file(&file, path) => return Ok(Some(file)),
            Ok(()) => continue, // The file was removed meanwhile, and other processes lock a new file.
            Err(Errno::WOULDBLOCK | Errno::INTR) => {}
            Err(errno @ (Errno::PERM | Errno::ACCESS | Errno::NOSYS)) => {
                return Err(call_error("flock", errno));
            }
            Err(errno) => return Err(wrong(errno)),
        }
        let elapsed = start.elapsed();
        if elapsed > STOPPED_WAIT {
            let pid = holder(&file);
            if held_since.0 != pid {
                held_since = (pid, Instant::now());
            }
            let is_frozen = pid.is_some() && held_since.1.elapsed() > FROZEN_WAIT;
            if is_frozen || pid.is_some_and(is_stopped) {
                return Ok(None);
            }
        }
        if elapsed > limit {
            return Err(ChannelError::Locked {
                path: path.display().to_string(),
                limit,
                holder: holder(&file).map_or("a process of another PID namespace".into(), |pid| {
                    format!("pid {pid}")
                }),
            });
        }
        std::thread::sleep(INTERVAL);
        check()?;
    }
}

fn is_file(file: &OwnedFd, path: &Path) -> bool {
    match (fstat(file), stat(path)) {
        (Ok(ours), Ok(there)) => (ours.st_dev, ours.st_ino) == (there.st_dev, there.st_ino),
        _ => false,
    }
}

fn holder(file: &OwnedFd) -> Option<i32> {
    let found = fstat(file).ok()?;
    lock_holder("FLOCK", found.st_dev, found.st_ino)
}

fn is_stopped(pid: i32) -> bool {
    matches!(process_state(pid), Ok(Some('T' | 't')))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wait_for_a_turn_is_interrupted_or_times_out_and_names_the_holder() {
        let path = std::env::temp_dir().join(format!("emberwatch-turn-{}", std::process::id()));
        let first = wait(&path, Duration::ZERO, || Ok(())).expect("nobody has it");
        let refusal = wait(&path, Duration::from_millis(1), || Ok(())).expect_err("it is taken");
        let pid = format!("held by pid {}", std::process::id());
        assert!(refusal.to_string().contains(&pid), "{refusal}");
        assert!(
            matches!(refusal, ChannelError::Locked { .. }),
            "agents wait on"
        );
        let refusal = wait(&path, LONGEST_WAIT, || Err(ChannelError::Interrupted));
        assert!(matches!(refusal, Err(ChannelError::Interrupted)));
        std::fs::remove_file(&path).expect("remove it");
        let second = wait(&path, Duration::ZERO, || Ok(())).expect("another file of that name");
        assert!(first.is_some() && second.is_some());
        drop(second);
        assert!(
            wait(&path, Duration::ZERO, || Ok(()))
                .expect("free again")
                .is_some()
        );
        std::fs::remove_file(&path).expect("clean up");
    }

    #[test]
    fn a_turn_ends_even_if_a_copy_of_its_file_stays_open() {
        let turn = Turn::take().expect("a turn");
        let copy = turn.lock.as_ref().map(|lock| lock.try_clone());
        let copy = copy.expect("it is alone").expect("a copy, as a child has");
        drop(turn);
        let path = own_channel_directory().expect("it is there").join(LOCK);
        let next = wait(&path, Duration::from_secs(5), || Ok(())).expect("it is free");
        assert!(next.is_some());
        drop(copy);
    }

    #[test]
    fn a_fork_and_the_turns_of_other_threads_exclude_each_other() {
        before_fork();
        let (sender, receiver) = std::sync::mpsc::channel();
        std::thread::scope(|scope| {
            scope.spawn(move || {
                let _turn = Turn::take().expect("a turn");
                sender.send(()).expect("the test waits");
            });
            let waited = receiver.recv_timeout(Duration::from_millis(50));
            after_fork();
            assert!(waited.is_err(), "it has a turn during the fork");
            receiver.recv().expect("its turn comes after the fork");
        });
    }
}
