//! A thread pool for work on several worlds at once.

use crate::errors::interrupted;
use emberwatch_acting::parallel::in_parallel;
use rayon::{ThreadPool, ThreadPoolBuilder};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::{Duration, Instant};

/// Time between two checks for signals. Shorter calls are not interrupted.
const LOOK: Duration = Duration::from_millis(50);

/// Returns a function for long work on this thread, which runs signal handlers from time to time. It returns whether one
/// raised an exception.
pub fn signals() -> impl FnMut() -> bool {
    let mut looked = Instant::now();
    move || {
        let looks = looked.elapsed() >= LOOK;
        if looks {
            looked = Instant::now();
        }
        looks && interrupted()
    }
}

/// A thread pool that belongs to one object. A global pool would be unusable after a fork, which copies no threads.
#[derive(Default)]
pub struct Pool {
    pid: u32,
    threads: Option<ThreadPool>,
}

#[derive(Clone, Copy)]
pub enum Threads {
    One,
    Several,
}

impl Pool {
    /// Runs `work` on the threads of the pool, which the first call in a process starts. If `is_short` is set, runs it
    /// on this thread, because sharing such short work would cost more time than it saves.
    pub fn work<R: Send>(&mut self, is_short: bool, work: impl FnOnce(Threads) -> R + Send) -> R {
        match self.threads(is_short) {
            Some(threads) => threads.install(|| work(Threads::Several)),
            None => work(Threads::One),
        }
    }

    /// Applies `work` to each task as [`Threads::each`] does, while this thread handles signals. Returns `None` if a
    /// signal handler raised an exception. Tasks that had not begun by then are dropped.
    pub fn each<T: Send, U: Send>(
        &mut self,
        is_short: bool,
        tasks: Vec<T>,
        work: impl Fn(T) -> U + Sync,
    ) -> Option<Vec<U>> {
        let Some(threads) = self.threads(is_short) else {
            let mut interrupts = signals();
            let tasks = tasks.into_iter();
            let unless_interrupted = |task| (!interrupts()).then(|| work(task));
            return tasks.map(unless_interrupted).collect();
        };
        let results = watched(threads, |is_over| {
            in_parallel(tasks, |task| {
                (!is_over.load(Ordering::Relaxed)).then(|| work(task))
            })
        });
        results?.into_iter().collect()
    }

    /// Returns the pool's threads; `None` if the work is short, or if the system could not start threads.
    fn threads(&mut self, is_short: bool) -> Option<&ThreadPool> {
        if is_short {
            return None;
        }
        self.forget_others();
        if self.threads.is_none() {
            self.pid = std::process::id();
            self.threads = ThreadPoolBuilder::new().build().ok();
        }
        self.threads.as_ref()
    }

    /// In a forked child, forgets the parent's threads. They do not run here, and dropping the pool would wait for
    /// them.
    fn forget_others(&mut self) {
        if self.pid != std::process::id() {
            std::mem::forget(self.threads.take());
        }
    }
}

/// Runs `work` on threads, while this thread handles signals. If a signal handler raises an exception, sets the flag
/// that `work` receives, waits for its end, and returns `None`.
pub fn watched<R: Send>(
    threads: &ThreadPool,
    work: impl FnOnce(&AtomicBool) -> R + Send,
) -> Option<R> {
    let is_over = &AtomicBool::new(false);
    let (sender, receiver) = channel();
    threads.in_place_scope(|scope| {
        scope.spawn(move |_| {
            // After an interrupt, nobody receives the result.
            let _ = sender.send(work(is_over));
        });
        loop {
            match receiver.recv_timeout(LOOK) {
                Ok(result) => return Some(result),
                Err(RecvTimeoutError::Timeout) if !interrupted() => {}
                // If the work panicked, the scope passes the panic to this thread.
                Err(_) => {
                    is_over.store(true, Ordering::Relaxed);
                    return None;
                }
            }
        }
    })
}

impl Drop for Pool {
    fn drop(&mut self) {
        self.forget_others();
    }
}

impl Threads {
    pub fn each<T: Send, U: Send>(
        self,
        tasks: impl IntoIterator<Item = T>,
        work: impl Fn(T) -> U + Sync,
    ) -> Vec<U> {
        match self {
            Self::One => tasks.into_iter().map(work).collect(),
            Self::Several => in_parallel(tasks, work),
        }
    }
}
