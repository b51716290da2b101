//! What Python calls of Rust: the module `emberwatch._native`, whose types are in `_native.pyi`.

use pyo3::prelude::*;

#[pymodule]
fn _native(_module: &Bound<'_, PyModule>) -> PyResult<()> {
    Ok(())
}
