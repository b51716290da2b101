//! Values that belong to the process that created them, and that only one thread can use at a time.

use crate::errors::{error, interrupted, raise_of_channel};
use emberwatch_messages::errors::ChannelError;
use emberwatch_sim::embedded::INSTANCE;
use pyo3::prelude::*;
use std::mem::ManuallyDrop;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::ThreadId;
use std::time::Duration;

/// Interval at which a thread that waits for another thread checks whether a signal has interrupted it.
const INTERVAL: Duration = Duration::from_millis(5);

/// A value that does not survive a fork: a server's channels, or worlds and their threads. A forked child gets an error
/// when it uses the value, and never drops it.
pub struct Owned<T: Send> {
    pid: u32,
    instance: String,
    slot: ManuallyDrop<Mutex<Slot<T>>>,
    freed: Condvar,
}

/// Without value and thread, it is closed.
struct Slot<T> {
    value: Option<T>,
    user: Option<ThreadId>,
}

enum Untaken {
    /// A signal handler raised an exception during the wait.
    Interrupted,
    /// This thread itself is using the value, in a call that a signal handler interrupted.
    Own,
}

impl<T> Slot<T> {
    fn take(&mut self) -> Option<T> {
        let value = self.value.take();
        if value.is_some() {
            self.user = Some(this_thread());
        }
        value
    }
}

fn this_thread() -> ThreadId {
    std::thread::current().id()
}

/// The value while this thread uses it. Dropping this frees it for other threads.
struct Taken<'a, T: Send> {
    owner: &'a Owned<T>,
    value: Option<T>,
}

impl<T: Send> Owned<T> {
    pub fn new(instance: &str, value: T) -> Self {
        let (value, user) = (Some(value), None);
        Self {
            pid: pid(),
            instance: instance.into(),
            slot: ManuallyDrop::new(Mutex::new(Slot { value, user })),
            freed: Condvar::new(),
        }
    }

    /// Uses the value with the interpreter lock released, so that other threads can run.
    pub fn with<R: Send>(
        &self,
        py: Python<'_>,
        act: impl FnOnce(&mut T) -> R + Send,
    ) -> PyResult<R> {
        self.check(py)?;
        let outcome = py.detach(|| {
            let taken = self.take(interrupted)?;
            Ok(taken.map(|value| act(self.taken(value).value_mut())))
        });
        match outcome {
            Ok(Some(outcome)) => Ok(outcome),
            Ok(None) => {
                let text = format!("{} closed", self.subject("is", "are"));
                Err(error(py, "EmberwatchError", (text, "closed")))
            }
            Err(untaken) => Err(self.untaken(py, untaken)),
        }
    }

    /// Uses the value for short work. Unlike [`Self::with`], keeps the interpreter locked unless another thread uses
    /// the value. Detects only forks that run Python's hooks, so call [`Self::check`] first if several threads share
    /// the work.
    pub fn with_briefly<R: Send>(
        &self,
        py: Python<'_>,
        act: impl FnOnce(&mut T) -> R + Send,
    ) -> PyResult<R> {
        if self.pid != known_pid() {
            self.check(py)?;
        }
        let free = self.lock().take();
        match free {
            Some(value) => Ok(act(self.taken(value).value_mut())),
            None => self.with(py, act),
        }
    }

    /// Drops the value. Does nothing in another process, or if it is closed already.
    pub fn close(&self, py: Python<'_>) -> PyResult<()> {
        if self.pid != pid() {
            return Ok(());
        }
        let ended = py.detach(|| self.end(interrupted));
        ended.map_err(|untaken| self.untaken(py, untaken))
    }

    fn untaken(&self, py: Python<'_>, why: Untaken) -> PyErr {
        match why {
            Untaken::Interrupted => raise_of_channel(py, ChannelError::Interrupted),
            Untaken::Own => {
                let subject = self.subject("is", "are");
                let text = format!(
                    "{subject} in use by this thread, in a call that a signal handler has interrupted: act after the call"
                );
                error(py, "EmberwatchError", (text, "in_use"))
            }
        }
    }

    pub fn check(&self, py: Python<'_>) -> PyResult<()> {
        if self.pid == pid() {
            return Ok(());
        }
        let what_to_do = if self.instance == INSTANCE {
            "close the environment here, or make it in the child"
        } else {
            "open a new one here (for environments: make them in the child)"
        };
        let subject = self.subject("belongs", "belong");
        let text = format!("{subject} to the process that forked this one: {what_to_do}");
        Err(error(py, "EmberwatchError", (text, "forked")))
    }

    fn subject(&self, singular: &str, plural: &str) -> String {
        if self.instance == INSTANCE {
            format!("these worlds {plural}")
        } else {
            format!("the connection to instance '{}' {singular}", self.instance)
        }
    }

    /// Waits until no other thread uses the value, unless `stops` ends the wait, then takes it. Returns `None` if it is
    /// closed.
    fn take(&self, stops: fn() -> bool) -> Result<Option<T>, Untaken> {
        loop {
            let mut slot = self.lock();
            match slot.user {
                None => return Ok(slot.take()),
                Some(user) if user == this_thread() => return Err(Untaken::Own),
                Some(_) => self.wait(slot),
            }
            if stops() {
                return Err(Untaken::Interrupted);
            }
        }
    }

    fn taken(&self, value: T) -> Taken<'_, T> {
        let value = Some(value);
        Taken { owner: self, value }
    }

    fn end(&self, stops: fn() -> bool) -> Result<(), Untaken> {
        if let Some(value) = self.take(stops)? {
            self.lock().user = None;
            self.freed.notify_all();
            drop(value);
        }
        Ok(())
    }

    /// Waits until the value is free, but at most one interval, because a thread that stopped waiting may have consumed
    /// the notification.
    fn wait(&self, slot: MutexGuard<'_, Slot<T>>) {
        let waited = self.freed.wait_timeout(slot, INTERVAL);
        drop(waited.unwrap_or_else(PoisonError::into_inner));
    }

    fn lock(&self) -> MutexGuard<'_, Slot<T>> {
        self.slot.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<T: Send> Taken<'_, T> {
    fn value_mut(&mut self) -> &mut T {
        self.value.as_mut().expect("invariant: until it is dropped")
    }
}

impl<T: Send> Drop for Taken<'_, T> {
    fn drop(&mut self) {
        let (value, user) = (self.value.take(), None);
        *self.owner.lock() = Slot { value, user };
        self.owner.freed.notify_all();
    }
}

impl<T: Send> Drop for Owned<T> {
    fn drop(&mut self) {
        if self.pid == pid() {
            // Releases the interpreter lock, because dropping the value may wait for another thread that needs this
            // lock.
            let end = || self.end(|| false);
            if Python::try_attach(|py| py.detach(end)).is_none() {
                let _ = end();
            }
        }
    }
}

/// The cached id of this process; 0 before the first use.
static PID: AtomicU32 = AtomicU32::new(0);

fn pid() -> u32 {
    std::process::id()
}

/// Returns the id of this process, with a system call only on the first use. The id is stale after a fork that did not
/// run Python's hooks, so use it only before work that needs no other threads, which a fork does not copy.
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

pub fn forget_pid() {
    PID.store(0, Ordering::Relaxed);
}
