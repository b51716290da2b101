//! Waits for other threads.

use emberwatch_messages::errors::ConnectionError;
use emberwatch_messages::interrupt::check_interrupt;
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};

/// The instance name that errors show. It is not a valid name for a server.
pub const INSTANCE: &str = "(embedded)";

/// How often a waiting call checks for an interrupt.
const INTERVAL: Duration = Duration::from_millis(5);

pub fn wait_for<T>(
    receiver: &Receiver<T>,
    start: Instant,
    timeout: Duration,
) -> Result<T, ConnectionError> {
    loop {
        let left = timeout.saturating_sub(start.elapsed());
        match receiver.recv_timeout(left.min(INTERVAL)) {
            Ok(next) => return Ok(next),
            Err(RecvTimeoutError::Timeout) if !left.is_zero() => check_interrupt()?,
            // The timeout has passed, or the job panicked before it sent a value.
            Err(_) => {
                return Err(ConnectionError::Timeout {
                    what: "a control request",
                    instance: INSTANCE.into(),
                    timeout,
                });
            }
        }
    }
}
