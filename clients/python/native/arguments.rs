//! Arguments of Python's callers, checked with one clear error each. Where a fast path does not apply,
//! `emberwatch/common/arguments.py` converts the argument or raises the error.

use crate::moves;
use crate::refusal::invalid;
use emberwatch_messages::control::WorldSeed;
use pyo3::prelude::*;
use pyo3::types::PyRange;
use std::ops::Range;
use std::time::Duration;

/// The number of a robot or world, or how many there are.
pub struct Number(pub u32);

impl<'py> FromPyObject<'_, 'py> for Number {
    type Error = PyErr;

    fn extract(given: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        let subject = "a number of robots or worlds";
        let number = checked(&given, "as_count", (&*given, subject, 0, u32::MAX))?;
        number.extract().map(Self)
    }
}

pub fn count(given: &Bound<'_, PyAny>, subject: &str) -> PyResult<u64> {
    checked(given, "as_count", (given, subject, 0, u64::MAX))?.extract()
}

pub fn paths(given: &Bound<'_, PyAny>, n_robots: usize, n_moves: usize) -> PyResult<Vec<u8>> {
    if let Some(moves) = moves::paths(given, n_robots, n_moves) {
        return Ok(moves);
    }
    let converted = checked(given, "as_moves", (given, n_robots, n_moves))?;
    let moves = moves::paths(&converted, n_robots, n_moves);
    Ok(moves.expect("invariant: as_moves returns valid moves"))
}

/// Returns the worlds of a reset, at most `n_worlds`, with their seeds. `seeds` has one for each world; `None`: the
/// server's choice.
pub fn seeds(
    py: Python<'_>,
    seeds: Option<&Bound<'_, PyAny>>,
    worlds: &Bound<'_, PyAny>,
    n_worlds: u32,
) -> PyResult<Vec<WorldSeed>> {
    let pairs: Vec<(Number, Option<u64>)> = arguments(py)?
        .call_method1("as_seeds", (seeds, worlds, n_worlds))?
        .extract()?;
    let pairs = pairs.into_iter();
    Ok(pairs
        .map(|(world, seed)| WorldSeed {
            world: world.0,
            seed,
        })
        .collect())
}

/// Checks that an argument is a Python `range` of consecutive robots or worlds within `whole`, at least one.
pub fn range_of(what: &str, given: &Bound<'_, PyAny>, whole: &Range<u32>) -> PyResult<Range<u32>> {
    let part = given.cast::<PyRange>().ok().and_then(|range| {
        let bound = |name| range.getattr(name).ok()?.extract::<u32>().ok();
        let is_consecutive = range.getattr("step").ok()?.extract::<i64>().ok()? == 1;
        let part = bound("start")?..bound("stop")?;
        let is_within = whole.start <= part.start && part.end <= whole.end;
        (is_consecutive && is_within && !part.is_empty()).then_some(part)
    });
    part.ok_or_else(|| {
        let Range { start, end } = whole;
        let expected = format!("a range of consecutive {what} within range({start}, {end})");
        let got = given
            .repr()
            .map_or_else(|error| error.to_string(), |it| it.to_string());
        invalid(given.py(), what, expected, got)
    })
}

pub fn absolute_path(path: &Bound<'_, PyAny>) -> PyResult<String> {
    let py = path.py();
    let absolute = py.import("os.path")?.call_method1("abspath", (path,))?;
    let paths = py.import("emberwatch.common.paths")?;
    paths.call_method1("utf8", ("path", absolute))?.extract()
}

pub fn duration(py: Python<'_>, seconds: f64) -> PyResult<Duration> {
    if !seconds.is_nan() && seconds >= 0.0 {
        return Ok(Duration::try_from_secs_f64(seconds.min(1e9)).unwrap_or_default());
    }
    let expected = "seconds of at least 0";
    Err(invalid(py, "timeout", expected, seconds))
}

fn checked<'py>(
    given: &Bound<'py, PyAny>,
    check: &str,
    arguments_of_check: impl pyo3::call::PyCallArgs<'py>,
) -> PyResult<Bound<'py, PyAny>> {
    arguments(given.py())?.call_method1(check, arguments_of_check)
}

fn arguments(py: Python<'_>) -> PyResult<Bound<'_, PyModule>> {
    py.import("emberwatch.common.arguments")
}
