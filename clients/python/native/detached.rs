//! Computations that unlock the interpreter for other threads.

use pyo3::prelude::*;

/// Minimum number of values for which unlocking is worthwhile: getting the interpreter back can take 5 ms.
const MANY: usize = 1 << 14;

/// Runs `work`, which processes `n_numbers` values. If there are many values, unlocks the interpreter meanwhile.
pub fn detached<R: Send>(py: Python<'_>, n_numbers: usize, work: impl FnOnce() -> R + Send) -> R {
    if n_numbers < MANY {
        work()
    } else {
        py.detach(work)
    }
}
