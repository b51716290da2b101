//! Model files and descriptions, read for Python's `Model` and `Description`.

use crate::airspace;
use crate::refusal::invalid;
use emberwatch_model::grid::{MAX_SIDE, Shape};
use emberwatch_model::hazards::Hazards;
use emberwatch_model::task::Task;
use emberwatch_model::{CellMap, Description, Model};
use emberwatch_sim::states_file::StatesFile;
use numpy::ToPyArray;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use std::collections::BTreeMap;

/// Returns the texts of built-in files by name. `"states"` are descriptions of recorded states.
#[pyfunction]
pub fn built_in(py: Python<'_>, kind: &str) -> PyResult<BTreeMap<&'static str, &'static str>> {
    match kind {
        "models" => Ok(Model::built_in_files().collect()),
        "tasks" => Ok(Task::built_in_files().collect()),
        "states" => Ok(StatesFile::built_in_descriptions().collect()),
        _ => Err(invalid(py, "kind", "'models', 'tasks' or 'states'", kind)),
    }
}

#[pyfunction]
pub fn read_model<'py>(py: Python<'py>, text: &str) -> PyResult<Bound<'py, PyDict>> {
    let model = model_of(text)?;
    let fields = described(py, &model)?;
    let ratio = model.ratio();
    fields.set_item("kernel", ratio.map(|it| it.kernel().to_pyarray(py)))?;
    fields.set_item("bias", ratio.map(|it| it.bias().to_pyarray(py)))?;
    fields.set_item("initial", model.initial().to_pyarray(py))?;
    fields.set_item("edge", model.edge())?;
    let transitions = model.file().transitions.iter();
    let transitions = transitions.map(|it| (&it.from, &it.to, it.base, &it.near, &it.times));
    fields.set_item("transitions", transitions.collect::<Vec<_>>())?;
    let maps = model.hazards().into_iter().flat_map(Hazards::maps);
    let maps = maps.map(|(name, map)| (name, map.to_pyarray(py)));
    fields.set_item("maps", maps.collect::<BTreeMap<_, _>>())?;
    Ok(fields)
}

/// Returns the text of a model file or a description with another sensor radius, in rows and columns.
#[pyfunction]
pub fn with_radius(text: &str, radius: i64) -> PyResult<String> {
    let mut file: toml::Table = toml::from_str(text).map_err(refused)?;
    let sensor = toml::Table::from_iter([("radius".into(), radius.into())]);
    file.insert("sensor".into(), sensor.into());
    toml::to_string(&file).map_err(refused)
}

#[pyfunction]
pub fn read_description<'py>(py: Python<'py>, text: &str) -> PyResult<Bound<'py, PyDict>> {
    let model = Description::model_of(text).map_err(refused)?;
    described(py, &model)
}

pub fn model_of(text: &str) -> PyResult<Model> {
    Model::from_toml(text).map_err(refused)
}

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
    let names: Vec<_> = states.clone().map(|it| &it.name).collect();
    fields.set_item("state_names", PyTuple::new(py, names)?)?;
    let colors: Vec<_> = states.map(|it| &it.color).collect();
    fields.set_item("state_colors", colors)?;
    let names = PyTuple::new(py, model.observation_names())?;
    fields.set_item("observation_names", names)?;
    let colors: Vec<_> = observations.map(|it| &it.color).collect();
    fields.set_item("observation_colors", colors)?;
    fields.set_item("observation_matrix", model.likelihood().to_pyarray(py))?;
    fields.set_item("reward", model.reward().to_pyarray(py))?;
    let no_fly = file.no_fly.as_ref().map(CellMap::grid);
    let no_fly = no_fly.map(|map| map.expect("invariant: a model's maps are checked"));
    let no_fly = no_fly.map(|map| map.mapv(|flag| flag != 0));
    let airspace = airspace::python(py, model.radius(), no_fly.as_ref())?;
    fields.set_item("airspace", airspace)?;
    Ok(fields)
}
