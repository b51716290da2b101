//! Ends waits early, for example on Ctrl-C in an interpreter that must run its signal handlers itself.

use super::errors::ChannelError;
use std::sync::OnceLock;

static CHECK: OnceLock<fn() -> bool> = OnceLock::new();

/// Sets the check for interrupts in this process. When `check` returns true, a wait ends with
/// [`ChannelError::Interrupted`]. A waiting thread calls `check` every 50 ms and when a signal arrives. The check can
/// be set only once; later calls have no effect.
pub fn interrupt_when(check: fn() -> bool) {
    CHECK.get_or_init(|| check);
}

/// Checks for an interrupt. Every long wait should call this every 50 ms.
///
/// # Errors
/// [`ChannelError::Interrupted`] if the wait must end.
pub fn check_interrupt() -> Result<(), ChannelError> {
    match CHECK.get() {
        Some(check) if check() => Err(ChannelError::Interrupted),
        _ => Ok(()),
    }
}
