//! Shares work between the calling thread and the threads of a pool.

use rayon::{Scope, ThreadPool};
use std::sync::{Mutex, PoisonError};

/// Runs all jobs on the calling thread and on the threads of a pool. Each thread takes the next job when it has
/// finished one, so that no job waits for a thread that wakes up late.
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

/// Starts a helper thread, which starts two further helpers before it works. If one thread woke all helpers, this would
/// take as long as many jobs.
fn start<'s>(scope: &Scope<'s>, helper: usize, n_helpers: usize, work: &'s (impl Fn() + Sync)) {
    if helper < n_helpers {
        scope.spawn(move |scope| {
            start(scope, 2 * helper + 1, n_helpers, work);
            start(scope, 2 * helper + 2, n_helpers, work);
            work();
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rayon::ThreadPoolBuilder;
    use std::collections::HashSet;
    use std::sync::Barrier;
    use std::thread::current;

    fn pool(n_threads: usize) -> ThreadPool {
        let pool = ThreadPoolBuilder::new().num_threads(n_threads).build();
        pool.expect("test threads")
    }

    #[test]
    fn every_job_is_done_once() {
        for (n_threads, n_jobs) in [(1, 0), (1, 5), (2, 1), (3, 100), (8, 3), (8, 1000)] {
            let mut done = vec![0; n_jobs];
            share(&pool(n_threads), n_jobs, done.iter_mut(), |job| *job += 1);
            assert_eq!(done, vec![1; n_jobs], "{n_threads} threads");
        }
    }

    #[test]
    fn all_threads_take_part_including_the_calling_one() {
        let (seen, all) = (Mutex::new(HashSet::new()), Barrier::new(4));
        share(&pool(4), 4, 0..4, |_| {
            // Each job waits for all others, so that no thread can run two of them.
            all.wait();
            seen.lock().expect("no panic").insert(current().id());
        });
        let seen = seen.into_inner().expect("no panic");
        assert_eq!(seen.len(), 4);
        assert!(seen.contains(&current().id()));
    }
}
