//! Model files: what Python's `Model` and `Description` hold.

use crate::refusal::invalid;
use emberwatch_protocol::grid::{MAX_SIDE, Shape};
use emberwatch_protocol::model::{Description, Model, parse_color};
use numpy::ToPyArray;
use numpy::ndarray::{Axis, stack};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};

/// The fields of a model file's model by name.
#[pyfunction]
pub fn read_model<'py>(py: Python<'py>, text: &str) -> PyResult<Bound<'py, PyDict>> {
    let model = model_of(text)?;
    let fields = described(py, &model)?;
    let views: Vec<_> = model.kernels().iter().map(|kernel| kernel.view()).collect();
    let kernels = stack(Axis(0), &views).expect("invariant: kernels of one size");
    fields.set_item("kernels", kernels.to_pyarray(py))?;
    fields.set_item("bias", model.bias().to_pyarray(py))?;
    fields.set_item("initial", model.initial().to_pyarray(py))?;
    Ok(fields)
}

/// The fields of a description of recorded worlds by name.
#[pyfunction]
pub fn read_description<'py>(py: Python<'py>, text: &str) -> PyResult<Bound<'py, PyDict>> {
    let model = Description::model_of(text).map_err(refused)?;
    described(py, &model)
}

/// The model of a file's text.
pub fn model_of(text: &str) -> PyResult<Model> {
    Model::from_toml(text).map_err(refused)
}

/// The shape of a grid.
pub fn shape_of(py: Python<'_>, height: usize, width: usize) -> PyResult<Shape> {
    let expected = format!("height and width within 1 to {MAX_SIDE}");
    let got = format!("{height} x {width}");
    Shape::new(height, width).map_err(|_| invalid(py, "grid", expected, got))
}

fn refused(error: impl ToString) -> PyErr {
    PyValueError::new_err(error.to_string())
}

fn described<'py>(py: Python<'py>, model: &Model) -> PyResult<Bound<'py, PyDict>> {
    let file = model.file();
    let states = file.states.iter();
    let observations = file.observations.iter();
    let fields = PyDict::new(py);
    fields.set_item("name", model.name())?;
    fields.set_item("state_names", names(py, states.clone().map(|it| &it.name))?)?;
    fields.set_item("state_colors", colors(py, states.map(|it| &it.color))?)?;
    fields.set_item(
        "observation_names",
        names(py, observations.clone().map(|it| &it.name))?,
    )?;
    fields.set_item(
        "observation_colors",
        colors(py, observations.map(|it| &it.color))?,
    )?;
    fields.set_item("observation_matrix", model.likelihood().to_pyarray(py))?;
    fields.set_item("reward", model.reward().to_pyarray(py))?;
    Ok(fields)
}

fn names<'a, 'py>(
    py: Python<'py>,
    of: impl Iterator<Item = &'a String>,
) -> PyResult<Bound<'py, PyTuple>> {
    PyTuple::new(py, of.collect::<Vec<_>>())
}

fn colors<'a, 'py>(
    py: Python<'py>,
    of: impl Iterator<Item = &'a String>,
) -> PyResult<Bound<'py, PyTuple>> {
    let color = |text: &String| {
        let [red, green, blue] =
            parse_color(text).expect("invariant: a model's colours are checked");
        (red, green, blue)
    };
    PyTuple::new(py, of.map(color).collect::<Vec<_>>())
}
