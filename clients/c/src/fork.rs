//! Forks and interrupts.

use emberwatch_messages::interrupt::interrupt_when;
use emberwatch_protocol::turn;
use std::ffi::c_int;
use std::sync::{Once, OnceLock};

unsafe extern "C" {
    fn pthread_atfork(
        prepare: Option<extern "C" fn()>,
        parent: Option<extern "C" fn()>,
        child: Option<extern "C" fn()>,
    ) -> c_int;
}

extern "C" fn before() {
    turn::before_fork();
}

extern "C" fn after() {
    turn::after_fork();
}

/// Makes a fork wait until no thread is creating or removing channels.
pub fn watch_forks() {
    static ONCE: Once = Once::new();
    // SAFETY: the functions only use atomics and sleep, and glibc forgets them when it unloads this library.
    ONCE.call_once(|| {
        let _ = unsafe { pthread_atfork(Some(before), Some(after), Some(after)) };
    });
}

/// Returns true to end a wait.
pub type InterruptCheck = Option<extern "C" fn() -> bool>;

/// Sets a function that waits call about every 50 ms, and when a signal arrives: if it returns true, the wait ends with
/// EW_FAILURE_INTERRUPTED. It can be set once per process, and must not throw, jump, or call this library. Without it,
/// signals do what the program set.
#[unsafe(no_mangle)]
pub extern "C" fn ew_interrupt_when(check: InterruptCheck) {
    static CHECK: OnceLock<extern "C" fn() -> bool> = OnceLock::new();
    if let Some(check) = check {
        CHECK.get_or_init(|| check);
        interrupt_when(|| CHECK.get().is_some_and(|check| check()));
    }
}
