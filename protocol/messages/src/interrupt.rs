//! Ends waits early, for example on Ctrl-C in an interpreter that must run its signal handlers itself.

use super::errors::ChannelError;
use std::sync::OnceLock;

static CHECK: OnceLock<fn() -> bool> = OnceLock::new();

/// Sets the check that ends waits of this process with [`ChannelError::Interrupted`] when it returns true. The waiting
/// thread calls it after each sleep, every 50 ms or when a signal arrives. Only the first call has an effect.
pub fn interrupt_when(check: fn() -> bool) {
    CHECK.get_or_init(|| check);
}

/// Checks for an interrupt, for other waits. They should also call it every 50 ms.
///
/// # Errors
/// [`ChannelError::Interrupted`] if the wait must end.
pub fn check_interrupt() -> Result<(), ChannelError> {
    match CHECK.get() {
        Some(check) if check() => Err(ChannelError::Interrupted),
        _ => Ok(()),
    }
}
