//! Threads for work on several worlds at once.

use emberwatch_learning::parallel::in_parallel;
use rayon::{ThreadPool, ThreadPoolBuilder};

/// A thread pool of one object alone: threads of a global pool do not survive a fork.
#[derive(Default)]
pub struct Pool {
    /// The process that started the threads.
    pid: u32,
    threads: Option<ThreadPool>,
}

/// Whether worlds are worked on in parallel.
#[derive(Clone, Copy)]
pub enum Threads {
    One,
    Several,
}

impl Pool {
    /// Works on the threads of the pool, which the first call in a process starts. With `is_short`, works here: handing
    /// the work to another thread would cost more than it gains.
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
            // The system gives no threads.
            None => work(Threads::One),
        }
    }

    /// In a forked child: leaves the parent's threads alone, which do not run here.
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
    /// The results in order.
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
