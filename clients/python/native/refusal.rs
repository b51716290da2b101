//! Errors about invalid arguments, and descriptions of the server's refusals.

use crate::errors::error;
use emberwatch_messages::message::Status;
use emberwatch_model::text::shortened;
use pyo3::prelude::*;
use std::fmt::Display;

/// Returns the name of a refusal's status code and a sentence that explains it; `None` for any other code.
#[pyfunction]
pub fn explain(status: u32, detail: u64) -> Option<(String, String)> {
    let status = Status::try_from(status).ok()?;
    let name = serde_json::to_value(status).ok()?;
    let is_refusal = status != Status::Ok;
    is_refusal.then_some((name.as_str()?.to_owned(), status.explain(detail)))
}

pub fn invalid(
    py: Python<'_>,
    subject: impl Display,
    expected: impl Display,
    got: impl Display,
) -> PyErr {
    let got = shortened(&got.to_string()).into_owned();
    let words = (subject.to_string(), expected.to_string(), got);
    error(py, "invalid", words)
}

pub fn failed(py: Python<'_>, problem: &str, code: &str) -> PyErr {
    error(py, "EmberwatchError", (problem, code))
}

pub fn refused(py: Python<'_>, problem: impl Display) -> PyErr {
    error(py, "InvalidArgumentError", (problem.to_string(),))
}
