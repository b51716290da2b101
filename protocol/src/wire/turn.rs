//! A lock between processes: one that makes or removes nodes, services or ports takes a turn (PROTOCOL.md section 1).
//!
//! During its turn no other process makes anything: what is unfinished was left by a dead one. The lock is a `flock`,
//! which ends with its process.

use super::directory::{not_usable, own_channel_directory};
use super::process::process_state;
use super::resources::call_error;
use emberwatch_messages::errors::ChannelError;
use emberwatch_messages::interrupt::check_interrupt;
use rustix::fs::{FlockOperation, Mode, OFlags, flock, fstat, major, minor, open, stat};
use rustix::io::Errno;
use std::cell::Cell;
use std::os::fd::OwnedFd;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// How long to wait for others, each of which takes milliseconds.
const LONGEST_WAIT: Duration = Duration::from_secs(10);

/// The same for what can also be done without a turn, or by the next program: closing and cleaning up.
const SHORT_WAIT: Duration = Duration::from_secs(1);

/// How long to wait before asking which process has the turn, and whether it is stopped.
const STOPPED_WAIT: Duration = Duration::from_millis(50);

/// A process that has had the turn for so long does not run: it may be frozen, which it does not show.
const FROZEN_WAIT: Duration = Duration::from_secs(2);

/// How often to try.
const INTERVAL: Duration = Duration::from_micros(500);

/// The file in the channel directory that is locked.
const LOCK: &str = "lock";

#[derive(Clone, Copy, PartialEq, Eq)]
enum Held {
    No,
    /// By this thread; no other process makes or removes anything.
    Alone,
    /// By a stopped process, which is not waited for.
    Unlocked,
}

/// Whether a thread of this process has its turn, or forks: the child of a fork within a turn would inherit locks that
/// nobody unlocks there. Of an atom and sleep, which survive a fork themselves.
static BUSY: AtomicBool = AtomicBool::new(false);

thread_local! {
    static HELD: Cell<Held> = const { Cell::new(Held::No) };
}

/// A turn; it ends when it is dropped. One within another of the same thread is part of that.
#[derive(Debug)]
pub struct Turn {
    is_outermost: bool,
    lock: Option<OwnedFd>,
}

/// Waits for the turns of other threads, and keeps them waiting; call it before a fork.
pub fn before_fork() {
    if HELD.get() == Held::No {
        while BUSY.swap(true, Ordering::Acquire) {
            std::thread::sleep(INTERVAL);
        }
    }
}

/// Lets them go on; call it after the fork, in the parent and in the child.
pub fn after_fork() {
    if HELD.get() == Held::No {
        BUSY.store(false, Ordering::Release);
    }
}

impl Turn {
    /// Waits for a turn. A process that has it and is stopped or frozen is not waited for.
    ///
    /// # Errors
    /// If others hold it for too long, or the directory cannot be written to.
    pub fn take() -> Result<Self, ChannelError> {
        Self::take_within(LONGEST_WAIT)
    }

    /// As [`Self::take`], but waits no longer than a limit.
    pub(crate) fn take_within(limit: Duration) -> Result<Self, ChannelError> {
        Self::take_unless(limit, check_interrupt)
    }

    /// As [`Self::take`], but for a short time and uninterrupted: to close what is open, and to clean up.
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

    /// Whether no other process has it.
    pub fn is_alone(&self) -> bool {
        HELD.get() == Held::Alone
    }
}

impl Drop for Turn {
    fn drop(&mut self) {
        if let Some(lock) = &self.lock {
            // Not by closing alone: a child of a fork may have a copy.
            let _ = flock(lock, FlockOperation::Unlock);
        }
        if self.is_outermost {
            HELD.set(Held::No);
            after_fork();
        }
    }
}

/// The lock; `None` if a stopped or frozen process has it.
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
            Ok(()) => continue, // It was removed meanwhile: others lock another file now.
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

/// The process that has the lock, by `/proc/locks`.
fn holder(file: &OwnedFd) -> Option<i32> {
    let found = fstat(file).ok()?;
    let (major, minor) = (major(found.st_dev), minor(found.st_dev));
    let inode = format!("{major:02x}:{minor:02x}:{}", found.st_ino);
    let locks = std::fs::read_to_string("/proc/locks").ok()?;
    // "1: FLOCK  ADVISORY  WRITE 4711 00:1a:5678 0 EOF"; a line of a waiting process begins with an arrow.
    locks.lines().find_map(|line| {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words[..] {
            [_, "FLOCK", _, "WRITE", pid, found, ..] if found == inode => pid.parse().ok(),
            _ => None,
        }
    })
}

fn is_stopped(pid: i32) -> bool {
    matches!(process_state(pid), Ok(Some('T' | 't')))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_turn_is_waited_for_and_its_holder_named() {
        let path = std::env::temp_dir().join(format!("emberwatch-turn-{}", std::process::id()));
        let first = wait(&path, Duration::ZERO, || Ok(())).expect("nobody has it");
        let refusal = wait(&path, Duration::from_millis(1), || Ok(())).expect_err("it is taken");
        let pid = format!("held by pid {}", std::process::id());
        assert!(refusal.to_string().contains(&pid), "{refusal}");
        assert!(
            matches!(refusal, ChannelError::Locked { .. }),
            "agents wait on"
        );
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
    fn a_turn_ends_though_a_copy_of_its_file_stays_open() {
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
    fn a_wait_for_a_turn_is_interrupted() {
        let path = std::env::temp_dir().join(format!("emberwatch-wait-{}", std::process::id()));
        let held = wait(&path, Duration::ZERO, || Ok(())).expect("nobody has it");
        let refusal = wait(&path, LONGEST_WAIT, || Err(ChannelError::Interrupted));
        assert!(matches!(refusal, Err(ChannelError::Interrupted)));
        drop(held);
        std::fs::remove_file(&path).expect("clean up");
    }

    #[test]
    fn a_fork_waits_for_the_turns_of_other_threads_and_they_for_it() {
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
