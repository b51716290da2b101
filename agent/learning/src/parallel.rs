//! Tasks of several worlds at once.

use rayon::prelude::*;

/// The results in order. One task alone is done here: handing it to another thread costs more than it gains.
pub fn in_parallel<T: Send, U: Send>(
    tasks: impl IntoIterator<Item = T>,
    work: impl Fn(T) -> U + Sync,
) -> Vec<U> {
    let tasks: Vec<T> = tasks.into_iter().collect();
    if tasks.len() == 1 {
        tasks.into_iter().map(&work).collect()
    } else {
        tasks.into_par_iter().map(&work).collect()
    }
}
