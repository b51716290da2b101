//! Computation for several worlds at once.

use rayon::prelude::*;

/// Runs tasks in parallel. Returns their results in order. A single task runs on the calling thread, which is faster,
/// and no task starts no threads.
pub fn in_parallel<T: Send, U: Send>(
    tasks: impl IntoIterator<Item = T>,
    work: impl Fn(T) -> U + Sync,
) -> Vec<U> {
    let tasks: Vec<T> = tasks.into_iter().collect();
    if tasks.len() <= 1 {
        tasks.into_iter().map(&work).collect()
    } else {
        tasks.into_par_iter().map(&work).collect()
    }
}
