//! The wait of servers and clients: spins while that pays, then blocks, but never beyond a deadline.

use super::ipc::Ipc;
use super::resources::ipc_error;
use super::spinning::Spinning;
use emberwatch_messages::errors::ChannelError;
use iceoryx2::port::listener::Listener;
use iceoryx2::prelude::FileDescriptorBased;
use std::cell::Cell;
use std::os::fd::BorrowedFd;
use std::time::{Duration, Instant};

pub use super::poll::{is_readable, sleep_until_event, sleep_until_readable};

#[derive(Debug, Default)]
pub struct Waiter {
    spinning: Cell<Spinning>,
}

impl Waiter {
    /// Polls until something arrives. Returns `None` if the timeout passes before that.
    ///
    /// `block` must not sleep longer than the duration passed to it. It is called repeatedly until the timeout, so it
    /// may return early for any reason.
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
        let mut spinning = self.spinning.get();
        spinning.begin(start);
        let arrived = loop {
            let arrived = poll()?;
            if arrived.is_some() {
                spinning.arrived();
                break arrived;
            }
            let now = Instant::now();
            let waited = now - start;
            if spinning.keeps_spinning(now) {
                std::hint::spin_loop();
            } else if waited < timeout {
                block(timeout - waited)?;
            } else {
                break None;
            }
        };
        self.spinning.set(spinning);
        Ok(arrived)
    }
}

/// Returns the descriptor that is readable while a listener has notifications to drain.
#[expect(unsafe_code, reason = "iceoryx2 hands out the raw descriptor only")]
pub fn descriptor(listener: &Listener<Ipc>) -> BorrowedFd<'_> {
    // SAFETY: the descriptor stays open as long as its listener, which the result borrows.
    unsafe { BorrowedFd::borrow_raw(listener.file_descriptor().native_handle()) }
}

/// Drops a listener's wake-ups, and returns whether there were any.
///
/// # Errors
/// If iceoryx2 cannot read them.
pub fn drain(listener: &Listener<Ipc>) -> Result<bool, ChannelError> {
    let drained = listener.try_wait(|_| {});
    drained
        .map(|n_drained| n_drained > 0)
        .map_err(ipc_error("drain wake-ups"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wait_ends_with_a_result_an_error_or_a_timeout() {
        let (mut calls, long) = (0, Duration::from_secs(9));
        let third = || {
            calls += 1;
            Ok::<_, &str>((calls == 3).then_some(calls))
        };
        let waited = Waiter::default().wait(long, third, |_| Ok(()));
        assert_eq!(waited, Ok(Some(3)));
        let failing = || Err::<Option<u8>, _>("gone");
        let waited = Waiter::default().wait(long, failing, |_| Ok(()));
        assert_eq!(waited, Err("gone"));
        let (mut longest, timeout) = (Duration::ZERO, Duration::from_millis(5));
        let block = |limit: Duration| {
            longest = longest.max(limit);
            Ok::<_, ()>(())
        };
        let waited = Waiter::default().wait(timeout, || Ok(None::<u8>), block);
        assert_eq!(waited, Ok(None));
        assert!(longest <= timeout);
    }
}
