//! The bounded wait that both sides use: spin, then yield, then block, never past a deadline.
//!
//! Measured on two cores (round trip of 64 bytes against 4 KiB): spinning answers in 0.9 us when
//! both processes have a core, but costs 115 us when they share one; `sched_yield` costs 1.6 us and
//! 4.8 us; blocking costs 53 us always. So: spin as long as a quick answer takes, yield while a
//! wake-up would cost more than it saves, then leave the processor to others.
//!
//! Yielding to a process that never sleeps costs its whole time slice, milliseconds, while a sleeper is
//! woken ahead of it. A [`Waiter`] that lost the processor that way stops yielding for a while: with
//! three busy processes on two cores that makes 17 times as many steps a second (11,600 for 670).

use crate::channels::{ChannelError, Ipc, ipc_error};
use iceoryx2::port::listener::Listener;
use iceoryx2::prelude::FileDescriptorBased;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use std::cell::Cell;
use std::os::fd::BorrowedFd;
use std::time::{Duration, Instant};

/// How long to poll without giving up the processor.
pub const SPIN: Duration = Duration::from_micros(5);

/// How long to poll, from the start, before blocking.
pub const YIELD: Duration = Duration::from_micros(50);

/// A yield that takes longer than this went to a process that never sleeps. Less than a time slice, milliseconds;
/// more than short pieces of work need, such as a snapshot's way to its file: with 200 us here, a snapshot each
/// 1,000 steps made steps 24 % slower (1.7 % so; medians of 11 pairs at 80,000 steps a second).
const LONG_YIELD: Duration = Duration::from_millis(1);

/// How long not to yield after that.
const CONTENDED: Duration = Duration::from_millis(100);

/// Waits, and remembers whether yielding pays.
#[derive(Debug, Default)]
pub struct Waiter {
    contended_until: Cell<Option<Instant>>,
}

impl Waiter {
    /// Polls until something arrives or the timeout has passed, then returns `None`.
    ///
    /// `block` may sleep for at most the duration it is given; it is called again and again until the
    /// timeout, so it may return early for any reason.
    ///
    /// # Errors
    /// The first error of `poll` or `block`.
    pub fn wait<T, E>(
        &self,
        timeout: Duration,
        mut poll: impl FnMut() -> Result<Option<T>, E>,
        mut block: impl FnMut(Duration) -> Result<(), E>,
    ) -> Result<Option<T>, E> {
        let start = Instant::now();
        loop {
            if let Some(arrived) = poll()? {
                return Ok(Some(arrived));
            }
            let now = Instant::now();
            let waited = now - start;
            if waited < SPIN {
                std::hint::spin_loop();
            } else if waited < YIELD && self.contended_until.get().is_none_or(|end| end < now) {
                self.give_way(now);
            } else if waited < timeout {
                block(timeout - waited)?;
            } else {
                return Ok(None);
            }
        }
    }

    fn give_way(&self, now: Instant) {
        rustix::thread::sched_yield();
        let back = Instant::now();
        if back - now > LONG_YIELD {
            self.contended_until.set(Some(back + CONTENDED));
        }
    }
}

/// The descriptor that is readable while a listener has notifications to drain.
#[expect(unsafe_code, reason = "iceoryx2 hands out the raw descriptor only")]
pub fn descriptor(listener: &Listener<Ipc>) -> BorrowedFd<'_> {
    // SAFETY: the descriptor stays open as long as its listener, which the result borrows.
    unsafe { BorrowedFd::borrow_raw(listener.file_descriptor().native_handle()) }
}

/// Takes note of a listener's wake-ups; returns whether there were any.
///
/// # Errors
/// [`ChannelError::Ipc`].
pub fn drain(listener: &Listener<Ipc>) -> Result<bool, ChannelError> {
    let drained = listener.try_wait(|_| {});
    drained
        .map(|n_drained| n_drained > 0)
        .map_err(ipc_error("drain wake-ups"))
}

/// Sleeps until one of the descriptors is readable, a signal arrives or the timeout has passed;
/// returns which of them are readable.
///
/// # Errors
/// The system's error, never `EINTR`.
pub fn sleep_until_readable(
    descriptors: &[BorrowedFd<'_>],
    timeout: Duration,
) -> Result<Vec<bool>, Errno> {
    match readable(descriptors, timeout) {
        Err(Errno::INTR) => Ok(vec![false; descriptors.len()]),
        other => other,
    }
}

/// The same; returns whether there is anything to look at, which a signal is too.
///
/// # Errors
/// The system's error, never `EINTR`.
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

/// Whether a descriptor is readable now.
pub fn is_readable(descriptor: BorrowedFd<'_>) -> bool {
    sleep_until_readable(&[descriptor], Duration::ZERO).is_ok_and(|readable| readable[0])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wait_ends_at_its_timeout_and_blocks_no_longer() {
        let mut longest = Duration::ZERO;
        let block = |limit: Duration| {
            longest = longest.max(limit);
            std::thread::sleep(limit.min(Duration::from_millis(1)));
            Ok::<_, ()>(())
        };
        let timeout = Duration::from_millis(5);
        assert_eq!(
            Waiter::default().wait(timeout, || Ok(None::<u8>), block),
            Ok(None)
        );
        assert!(longest <= timeout);
    }

    #[test]
    fn what_arrives_is_returned_and_errors_end_the_wait() {
        let mut calls = 0;
        let third = || {
            calls += 1;
            Ok::<_, &str>((calls == 3).then_some(calls))
        };
        assert_eq!(
            Waiter::default().wait(Duration::from_secs(9), third, |_| Ok(())),
            Ok(Some(3))
        );
        let failing = || Err::<Option<u8>, _>("gone");
        assert_eq!(
            Waiter::default().wait(Duration::from_secs(9), failing, |_| Ok(())),
            Err("gone")
        );
    }
}
