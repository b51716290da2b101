//! Conversion of a caller's moves, which are arrays of integers, to bytes.

use emberwatch_model::path::check_moves;
use numpy::{Element, PyArray1, PyReadonlyArrayDyn, PyUntypedArray, PyUntypedArrayMethods};
use pyo3::PyTypeInfo;
use pyo3::prelude::*;

/// Returns paths of `n_moves` moves for `n_robots` robots as bytes. Returns `None` unless they are valid moves in a
/// plain array of `int64` or `uint8`. After `None`, `emberwatch/common/arguments.py` converts them or raises an error.
pub fn paths(given: &Bound<'_, PyAny>, n_robots: usize, n_moves: usize) -> Option<Vec<u8>> {
    let expected = (n_robots, n_moves);
    let fast = read::<i64>(given, expected, |value| {
        u8::try_from(value).unwrap_or(u8::MAX)
    });
    let moves = fast.or_else(|| read::<u8>(given, expected, |value| value))?;
    check_moves(&moves).is_ok().then_some(moves)
}

/// Converts choices, one per row; returns `None` unless they are a plain `int64` array of values below `n_choices`.
#[pyfunction]
pub fn choices<'py>(
    given: &Bound<'py, PyAny>,
    n_rows: usize,
    n_choices: u8,
) -> Option<Bound<'py, PyArray1<u8>>> {
    let is_plain = given
        .cast::<PyUntypedArray>()
        .is_ok_and(|it| it.ndim() == 1);
    let byte = |value| u8::try_from(value).unwrap_or(u8::MAX);
    let chosen = is_plain.then(|| read::<i64>(given, (1, n_rows), byte));
    let chosen = chosen?.filter(|chosen| chosen.iter().all(|&choice| choice < n_choices))?;
    Some(PyArray1::from_vec(given.py(), chosen))
}

fn read<T: Element + Copy>(
    given: &Bound<'_, PyAny>,
    (n_robots, n_moves): (usize, usize),
    byte: impl Fn(T) -> u8,
) -> Option<Vec<u8>> {
    // Subclasses of NumPy's array type do not count as plain arrays, because they can mask values.
    let is_plain = given.get_type().is(PyUntypedArray::type_object(given.py()));
    let array = is_plain.then(|| given.extract::<PyReadonlyArrayDyn<'_, T>>());
    let array = array?.ok()?;
    let shape = array.shape();
    let fits = shape == [n_robots, n_moves] || n_robots == 1 && shape == [n_moves];
    fits.then(|| match array.as_slice() {
        Ok(moves) => moves.iter().map(|&value| byte(value)).collect(),
        Err(_) => array.as_array().iter().map(|&value| byte(value)).collect(),
    })
}
