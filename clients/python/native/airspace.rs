//! Where robots may fly and what they see, as Python's `Airspace` says it.

use crate::refusal::invalid;
use emberwatch_protocol::model::Pays;
use emberwatch_protocol::{Airspace, Shape};
use numpy::PyReadonlyArray2;
use pyo3::prelude::*;
use std::sync::Arc;

/// The attributes of Python's `Airspace` that paths depend on: what differs from ring to ring does not.
#[derive(FromPyObject)]
pub struct Given<'py> {
    radius: usize,
    pays: String,
    no_fly: Option<PyReadonlyArray2<'py, bool>>,
}

impl Given<'_> {
    /// The airspace of a grid.
    pub fn on_grid(&self, py: Python<'_>, shape: Shape) -> PyResult<Airspace> {
        let no_fly = self.no_fly.as_ref().map(|map| map.as_array().to_owned());
        let dim = no_fly.as_ref().map_or(shape.dim(), |map| map.dim());
        if dim != shape.dim() {
            let (expected, got) = (format!("shape {:?}", shape.dim()), format!("{dim:?}"));
            return Err(invalid(py, "airspace: no_fly", expected, got));
        }
        let pays = match &*self.pays {
            "seen" => Pays::Seen,
            _ => Pays::Visited,
        };
        let no_fly = no_fly.map(Arc::new);
        Ok(Airspace::new(shape, no_fly, self.radius, 1, pays))
    }
}
