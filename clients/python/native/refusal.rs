//! Errors of arguments that make no sense, and the words of the server's refusals.

use crate::errors::error;
use emberwatch_messages::message::Status;
use pyo3::prelude::*;
use std::fmt::Display;

/// The name of a status code, and its sentence for people; `None` if no refusal has the code.
#[pyfunction]
pub fn explain(status: u32, detail: u64) -> Option<(String, String)> {
    let status = Status::try_from(status).ok()?;
    let name = serde_json::to_value(status).ok()?;
    let is_refusal = status != Status::Ok;
    is_refusal.then_some((name.as_str()?.to_owned(), status.explain(detail)))
}

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

/// An impossible argument, in a sentence of its own.
pub fn refused(py: Python<'_>, problem: impl Display) -> PyErr {
    error(py, "InvalidArgumentError", (problem.to_string(),))
}
