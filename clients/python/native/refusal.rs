//! The package's errors.

use pyo3::call::PyCallArgs;
use pyo3::prelude::*;
use std::fmt::Display;

/// An impossible argument: `InvalidArgumentError`.
pub fn invalid(
    py: Python<'_>,
    subject: impl Display,
    expected: impl Display,
    got: impl Display,
) -> PyErr {
    let problem = format!("{subject}: expected {expected}, got {got}");
    raised(py, "InvalidArgumentError", (problem,))
}

/// An `EmberwatchError` with a code.
pub fn failed(py: Python<'_>, problem: &str, code: &str) -> PyErr {
    raised(py, "EmberwatchError", (problem, code))
}

fn raised<'py>(py: Python<'py>, class: &str, arguments: impl PyCallArgs<'py>) -> PyErr {
    let made = py
        .import("emberwatch.errors")
        .and_then(|errors| errors.getattr(class)?.call1(arguments));
    made.map_or_else(|error| error, PyErr::from_value)
}
