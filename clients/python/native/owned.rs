//! What belongs to the process that made it, and to one thread at a time.

use crate::errors::{error, interrupted, raise_of_channel};
use emberwatch_messages::errors::ChannelError;
use pyo3::prelude::*;
use std::mem::ManuallyDrop;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// How often a thread that waits for another looks whether it was interrupted.
const INTERVAL: Duration = Duration::from_millis(5);

/// Something of iceoryx2's, which does not survive a fork: a child neither uses nor drops it.
pub struct Owned<T: Send> {
    pid: u32,
    instance: String,
    slot: ManuallyDrop<Mutex<Slot<T>>>,
    freed: Condvar,
}

enum Slot<T> {
    Free(T),
    /// By a thread that is not done with it yet.
    Taken,
    Closed,
}

/// Puts back what a thread took, or drops what is left of it.
struct Taken<'a, T: Send> {
    owner: &'a Owned<T>,
    value: Option<T>,
}

impl<T: Send> Owned<T> {
    pub fn new(instance: &str, value: T) -> Self {
        Self {
            pid: pid(),
            instance: instance.into(),
            slot: ManuallyDrop::new(Mutex::new(Slot::Free(value))),
            freed: Condvar::new(),
        }
    }

    /// Uses it without the interpreter, which other threads have meanwhile.
    ///
    /// # Errors
    /// If it is closed, another process's, or the wait for other threads was interrupted.
    pub fn with<R: Send>(
        &self,
        py: Python<'_>,
        act: impl FnOnce(&mut T) -> R + Send,
    ) -> PyResult<R> {
        self.check(py)?;
        let outcome = py.detach(|| {
            let mut taken = self.take()?;
            Some(taken.value.as_mut().map(act))
        });
        match outcome {
            Some(Some(outcome)) => Ok(outcome),
            Some(None) => {
                let text = format!("the connection to instance '{}' is closed", self.instance);
                Err(error(py, "EmberwatchError", (text, "closed")))
            }
            None => Err(raise_of_channel(py, ChannelError::Interrupted)),
        }
    }

    /// As [`Self::with`], keeping the interpreter for what is over soon, unless another thread uses the value just now.
    /// Notices forks by Python's hooks alone: call [`Self::check`] before what other threads take part in.
    ///
    /// # Errors
    /// As [`Self::with`].
    pub fn with_briefly<R: Send>(
        &self,
        py: Python<'_>,
        act: impl FnOnce(&mut T) -> R + Send,
    ) -> PyResult<R> {
        if self.pid != known_pid() {
            self.check(py)?;
        }
        let taken = match &mut *self.lock() {
            slot @ Slot::Free(_) => match std::mem::replace(slot, Slot::Taken) {
                Slot::Free(value) => Some(value),
                _ => None,
            },
            _ => None,
        };
        match taken {
            Some(value) => {
                let value = Some(value);
                let mut taken = Taken { owner: self, value };
                let value = taken.value.as_mut().expect("invariant: just taken");
                Ok(act(value))
            }
            None => self.with(py, act),
        }
    }

    /// Drops it. In another process it stays as it is; it may be closed again.
    ///
    /// # Errors
    /// If the wait for other threads was interrupted: then it is still open.
    pub fn close(&self, py: Python<'_>) -> PyResult<()> {
        if self.pid != pid() || py.detach(|| self.end(interrupted)) {
            return Ok(());
        }
        Err(raise_of_channel(py, ChannelError::Interrupted))
    }

    /// Refuses any other process than that which made it.
    pub fn check(&self, py: Python<'_>) -> PyResult<()> {
        if self.pid == pid() {
            return Ok(());
        }
        let text = format!(
            "the connection to instance '{}' belongs to the process that forked this one; open a new one here (for \
             environments: make them in the child)",
            self.instance
        );
        Err(error(py, "EmberwatchError", (text, "forked")))
    }

    /// Waits for other threads; `None` if a signal's handler ended that.
    fn take(&self) -> Option<Taken<'_, T>> {
        let mut slot = self.lock();
        loop {
            match std::mem::replace(&mut *slot, Slot::Taken) {
                Slot::Free(value) => {
                    return Some(Taken {
                        owner: self,
                        value: Some(value),
                    });
                }
                Slot::Closed => {
                    *slot = Slot::Closed;
                    return Some(Taken {
                        owner: self,
                        value: None,
                    });
                }
                Slot::Taken => {
                    self.wait(slot);
                    if interrupted() {
                        return None;
                    }
                    slot = self.lock();
                }
            }
        }
    }

    /// Takes it for good, and waits for a thread that uses it; `false` once `stops` ends the wait.
    fn end(&self, stops: fn() -> bool) -> bool {
        let mut slot = self.lock();
        loop {
            match std::mem::replace(&mut *slot, Slot::Closed) {
                Slot::Free(value) => {
                    drop(slot);
                    self.freed.notify_all();
                    drop(value);
                    return true;
                }
                Slot::Closed => return true,
                Slot::Taken => {
                    *slot = Slot::Taken;
                    self.wait(slot);
                    if stops() {
                        return false;
                    }
                    slot = self.lock();
                }
            }
        }
    }

    /// Waits until it is free, or for an interval: threads that give up may leave others unnotified.
    fn wait(&self, slot: MutexGuard<'_, Slot<T>>) {
        let waited = self.freed.wait_timeout(slot, INTERVAL);
        drop(waited.unwrap_or_else(PoisonError::into_inner));
    }

    fn lock(&self) -> MutexGuard<'_, Slot<T>> {
        self.slot.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<T: Send> Drop for Taken<'_, T> {
    fn drop(&mut self) {
        if let Some(value) = self.value.take() {
            *self.owner.lock() = Slot::Free(value);
            self.owner.freed.notify_all();
        }
    }
}

impl<T: Send> Drop for Owned<T> {
    fn drop(&mut self) {
        if self.pid == pid() {
            // Not attached: what ends here may wait for another thread that needs the interpreter.
            let end = || self.end(|| false);
            if Python::try_attach(|py| py.detach(end)).is_none() {
                end();
            }
        }
    }
}

/// This process's number; 0 until it is asked for.
static PID: AtomicU32 = AtomicU32::new(0);

fn pid() -> u32 {
    std::process::id()
}

/// This process's number, without a system call after the first one. A fork that does not run Python's hooks is not
/// noticed: for what no thread of the parent takes part in.
fn known_pid() -> u32 {
    match PID.load(Ordering::Relaxed) {
        0 => {
            let pid = pid();
            PID.store(pid, Ordering::Relaxed);
            pid
        }
        pid => pid,
    }
}

/// Has a forked child ask for its number again.
pub fn forget_pid() {
    PID.store(0, Ordering::Relaxed);
}
