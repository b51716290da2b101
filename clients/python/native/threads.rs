//! A thread pool for work on several worlds at once.

use emberwatch_acting::parallel::in_parallel;
use rayon::{ThreadPool, ThreadPoolBuilder};

/// A thread pool that belongs to one object. A global pool would be unusable after a fork, which copies no threads.
#[derive(Default)]
pub struct Pool {
    /// The id of the process that started the threads.
    pid: u32,
    threads: Option<ThreadPool>,
}

/// How many threads share the work.
#[derive(Clone, Copy)]
pub enum Threads {
    One,
    Several,
}

impl Pool {
    /// Runs `work` on the threads of the pool, which the first call in a process starts. If `is_short` is set, runs it
    /// on this thread, because sharing such short work would cost more time than it saves.
    pub fn work<R: Send>(&mut self, is_short: bool, work: impl FnOnce(Threads) -> R + Send) -> R {
        if is_short {
            return work(Threads::One);
        }
        self.forget_others();
        if self.threads.is_none() {
            self.pid = std::process::id();
            self.threads = ThreadPoolBuilder::new().build().ok();
        }
        match &self.threads {
            Some(threads) => threads.install(|| work(Threads::Several)),
            // The system could not start the pool's threads.
            None => work(Threads::One),
        }
    }

    /// In a forked child, forgets the parent's threads. They do not run here, and dropping the pool would wait for
    /// them.
    fn forget_others(&mut self) {
        if self.pid != std::process::id() {
            std::mem::forget(self.threads.take());
        }
    }
}

impl Drop for Pool {
    fn drop(&mut self) {
        self.forget_others();
    }
}

impl Threads {
    /// Applies `work` to each task. Returns the results in the order of the tasks.
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
