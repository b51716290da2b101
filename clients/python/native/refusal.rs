//! Errors of arguments that make no sense.

use crate::errors::error;
use pyo3::prelude::*;
use std::fmt::Display;

/// An impossible argument: `InvalidArgumentError`.
pub fn invalid(
    py: Python<'_>,
    subject: impl Display,
    expected: impl Display,
    got: impl Display,
) -> PyErr {
    let words = (subject.to_string(), expected.to_string(), got.to_string());
    error(py, "invalid", words)
}

/// An `EmberwatchError` with a code.
pub fn failed(py: Python<'_>, problem: &str, code: &str) -> PyErr {
    error(py, "EmberwatchError", (problem, code))
}
