//! Keeps forks out of the turns in which channels are made.

use emberwatch_protocol::turn;
use pyo3::prelude::*;
use pyo3::types::IntoPyDict;

/// Has Python call the hooks at each fork of this process.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    let py = module.py();
    let after = wrap_pyfunction!(after_fork, module)?;
    let hooks = [
        ("before", wrap_pyfunction!(before_fork, module)?),
        ("after_in_parent", after.clone()),
        ("after_in_child", after),
    ];
    let os = py.import("os")?;
    os.call_method("register_at_fork", (), Some(&hooks.into_py_dict(py)?))?;
    Ok(())
}

#[pyfunction]
fn before_fork(py: Python<'_>) {
    py.detach(turn::before_fork);
}

#[pyfunction]
fn after_fork() {
    turn::after_fork();
}
