//! Hooks for forks of this process. A fork waits until no thread is creating or removing a channel. In the child, the
//! cached process id of the parent is cleared.

use crate::owned::forget_pid;
#[cfg(target_os = "linux")]
use emberwatch_protocol::turn;
use pyo3::prelude::*;
use pyo3::types::IntoPyDict;

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    let py = module.py();
    let hooks = [
        ("before", wrap_pyfunction!(before_fork, module)?),
        ("after_in_parent", wrap_pyfunction!(after_fork, module)?),
        (
            "after_in_child",
            wrap_pyfunction!(after_fork_in_child, module)?,
        ),
    ];
    let os = py.import("os")?;
    os.call_method("register_at_fork", (), Some(&hooks.into_py_dict(py)?))?;
    Ok(())
}

#[pyfunction]
fn before_fork(py: Python<'_>) {
    #[cfg(target_os = "linux")]
    py.detach(turn::before_fork);
    #[cfg(not(target_os = "linux"))]
    let _ = py;
}

#[pyfunction]
fn after_fork() {
    #[cfg(target_os = "linux")]
    turn::after_fork();
}

#[pyfunction]
fn after_fork_in_child() {
    forget_pid();
    after_fork();
}
