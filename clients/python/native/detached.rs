//! Long computations that release the interpreter lock meanwhile, so that other threads can run.

use pyo3::prelude::*;

/// Minimum number of values for which releasing the interpreter lock is worthwhile: getting it back can take 5 ms.
const MANY: usize = 1 << 14;

/// Runs `work`, which processes `n_numbers` values. If there are many values, releases the interpreter lock meanwhile.
pub fn detached<R: Send>(py: Python<'_>, n_numbers: usize, work: impl FnOnce() -> R + Send) -> R {
    if n_numbers < MANY {
        work()
    } else {
        py.detach(work)
    }
}
