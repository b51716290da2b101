//! The airspace of a grid, built from Python's `Airspace`: where robots may fly, and what they see.

use crate::refusal::invalid;
use emberwatch_model::{Airspace, Grid, Shape};
use emberwatch_model::{CellMap, DescribedState, Description, ObservationEntry, SensorEntry};
use numpy::{PyReadonlyArray2, ToPyArray};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::sync::Arc;

/// Makes Python's `Airspace`.
pub fn python<'py>(
    py: Python<'py>,
    radius: usize,
    no_fly: Option<&Grid<bool>>,
) -> PyResult<Bound<'py, PyAny>> {
    let fields = PyDict::new(py);
    fields.set_item("radius", radius)?;
    fields.set_item("no_fly", no_fly.map(|map| map.to_pyarray(py)))?;
    let module = py.import("emberwatch.model.airspace")?;
    module.getattr("Airspace")?.call((), Some(&fields))
}

/// The attributes of Python's `Airspace`.
#[derive(FromPyObject)]
pub struct Given<'py> {
    radius: usize,
    no_fly: Option<PyReadonlyArray2<'py, bool>>,
}

impl Given<'_> {
    pub fn on_grid(&self, py: Python<'_>, shape: Shape) -> PyResult<Airspace> {
        let no_fly = self.no_fly.as_ref().map(|map| map.as_array().to_owned());
        let dim = no_fly.as_ref().map_or(shape.dim(), |map| map.dim());
        if dim != shape.dim() {
            let (expected, got) = (format!("shape {:?}", shape.dim()), format!("{dim:?}"));
            return Err(invalid(py, "airspace: no_fly", expected, got));
        }
        let no_fly = no_fly.map(Arc::new);
        Ok(Airspace::new(shape, no_fly, self.radius))
    }

    /// Describes worlds whose model is hidden, so that only the number of observed values is known. Treats each value
    /// as a state that the sensor shows without errors.
    pub fn seen(&self, n_observations: usize) -> Description {
        let shown = |value: usize| {
            (0..n_observations)
                .map(|other| f64::from(other == value))
                .collect()
        };
        let color = String::from("#000000");
        let rows = self.no_fly.as_ref().map(|map| {
            let rows = map.as_array();
            let rows = rows.outer_iter();
            rows.map(|row| row.iter().map(|&flag| u8::from(flag)).collect())
                .collect()
        });
        let state = |value| DescribedState {
            name: format!("state-{value}"),
            color: color.clone(),
            reward: 0.0,
            observed_as: shown(value),
        };
        let observation = |value| ObservationEntry {
            name: format!("value-{value}"),
            color: color.clone(),
        };
        Description {
            name: "hidden".into(),
            step: "unknown".into(),
            no_fly: rows.map(CellMap::Rows),
            sensor: Some(SensorEntry {
                radius: self.radius,
            }),
            states: (0..n_observations).map(state).collect(),
            observations: (0..n_observations).map(observation).collect(),
        }
    }
}
