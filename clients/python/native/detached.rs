//! Work that leaves the interpreter to other threads.

use pyo3::prelude::*;

/// Fewest numbers for which that is worth it: getting the interpreter back may take 5 ms.
const MANY: usize = 1 << 14;

/// Works on so many numbers: without the interpreter if they are many.
pub fn detached<R: Send>(py: Python<'_>, n_numbers: usize, work: impl FnOnce() -> R + Send) -> R {
    if n_numbers < MANY {
        work()
    } else {
        py.detach(work)
    }
}
