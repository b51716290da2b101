//! What ends waits early, such as Ctrl-C in an interpreter that must run its signal handlers itself.

use super::errors::ChannelError;
use std::sync::OnceLock;

static CHECK: OnceLock<fn() -> bool> = OnceLock::new();

/// From now on, waits of this process end with [`ChannelError::Interrupted`] once `check` says so. They ask when they
/// have slept, each 50 ms or when a signal arrives, on the thread that waits. The first check stays.
pub fn interrupt_when(check: fn() -> bool) {
    CHECK.get_or_init(|| check);
}

/// For waits of one's own, which should ask so often.
///
/// # Errors
/// [`ChannelError::Interrupted`], if the wait is to end.
pub fn check_interrupt() -> Result<(), ChannelError> {
    match CHECK.get() {
        Some(check) if check() => Err(ChannelError::Interrupted),
        _ => Ok(()),
    }
}
