//! Shares work among threads, of which the calling one is the first.

use rayon::{Scope, ThreadPool};
use std::sync::{Mutex, PoisonError};

/// Does all jobs, on the calling thread and on those of a pool. Each thread takes the next job when it is done with one,
/// so that one that wakes up late delays nobody.
pub(super) fn share<J: Send>(
    threads: &ThreadPool,
    n_jobs: usize,
    jobs: impl Iterator<Item = J> + Send,
    work: impl Fn(J) + Sync,
) {
    let n_helpers = threads.current_num_threads().min(n_jobs).saturating_sub(1);
    let jobs = Mutex::new(jobs);
    let next = || {
        let jobs = jobs.lock();
        jobs.unwrap_or_else(PoisonError::into_inner).next()
    };
    let work_off = || {
        while let Some(job) = next() {
            work(job);
        }
    };
    threads.in_place_scope(|scope| {
        start(scope, 0, n_helpers, &work_off);
        work_off();
    });
}

/// Starts a helper, which starts two others before it works: waking all of them from one thread would take as long as
/// many jobs.
fn start<'s>(scope: &Scope<'s>, helper: usize, n_helpers: usize, work: &'s (impl Fn() + Sync)) {
    if helper < n_helpers {
        scope.spawn(move |scope| {
            start(scope, 2 * helper + 1, n_helpers, work);
            start(scope, 2 * helper + 2, n_helpers, work);
            work();
        });
    }
}
