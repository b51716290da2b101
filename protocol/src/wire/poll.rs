//! Waits for file descriptors.

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use std::os::fd::BorrowedFd;
use std::time::Duration;

/// Sleeps until one of the descriptors is readable, a signal arrives, or the timeout has passed. Returns for each
/// descriptor whether it is readable.
///
/// # Errors
/// If the system cannot wait. The error is never `EINTR`.
pub fn sleep_until_readable(
    descriptors: &[BorrowedFd<'_>],
    timeout: Duration,
) -> Result<Vec<bool>, Errno> {
    match readable(descriptors, timeout) {
        Err(Errno::INTR) => Ok(vec![false; descriptors.len()]),
        other => other,
    }
}

/// Sleeps as [`sleep_until_readable`] does. Returns whether a descriptor is readable or a signal arrived.
///
/// # Errors
/// If the system cannot wait. The error is never `EINTR`.
pub fn sleep_until_event(descriptors: &[BorrowedFd<'_>], timeout: Duration) -> Result<bool, Errno> {
    match readable(descriptors, timeout) {
        Err(Errno::INTR) => Ok(true),
        other => other.map(|readable| readable.contains(&true)),
    }
}

fn readable(descriptors: &[BorrowedFd<'_>], timeout: Duration) -> Result<Vec<bool>, Errno> {
    let mut polled: Vec<PollFd<'_>> = descriptors
        .iter()
        .map(|fd| PollFd::from_borrowed_fd(*fd, PollFlags::IN))
        .collect();
    let timeout = Timespec::try_from(timeout).unwrap_or(Timespec {
        tv_sec: 1,
        tv_nsec: 0,
    });
    poll(&mut polled, Some(&timeout))?;
    Ok(polled.iter().map(|fd| !fd.revents().is_empty()).collect())
}

pub fn is_readable(descriptor: BorrowedFd<'_>) -> bool {
    sleep_until_readable(&[descriptor], Duration::ZERO).is_ok_and(|readable| readable[0])
}
