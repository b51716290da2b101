//! The simulator's own step from any states, for Python's `Model.advance`.

use crate::detached::detached;
use crate::errors::{check_memory, raised};
use crate::model::{model_of, shape_of};
use crate::refusal::{invalid, refused};
use crate::threads::signals;
use emberwatch_model as model;
use numpy::ndarray::Array3;
use numpy::{IntoPyArray, PyArray3, PyReadonlyArray1, PyReadonlyArray3};
use pyo3::prelude::*;

/// The transition of worlds for one model on one grid. Threads can share it.
#[pyclass(frozen, module = "emberwatch._native")]
pub struct Dynamics {
    n_states: usize,
    dynamics: model::Dynamics,
}

#[pymethods]
impl Dynamics {
    #[new]
    fn new(py: Python<'_>, model: &str, height: usize, width: usize) -> PyResult<Self> {
        let (model, shape) = (model_of(model)?, shape_of(py, height, width)?);
        let n_bytes = model::Dynamics::n_bytes(&model, shape);
        check_memory(py, format_args!("a world of {shape} cells"), n_bytes)?;
        let dynamics = model::Dynamics::new(&model, shape);
        Ok(Self {
            n_states: model.n_states(),
            dynamics: dynamics.map_err(|error| refused(py, error))?,
        })
    }

    /// Returns the states one step after `states`, `[n, H, W]`. `seeds`, `[n]`, has one seed per world; `step` is the
    /// step since the beginning of the burn-in. The Python class has checked the shapes.
    fn advance<'py>(
        &self,
        py: Python<'py>,
        states: PyReadonlyArray3<'py, u8>,
        seeds: PyReadonlyArray1<'py, u64>,
        step: u64,
    ) -> PyResult<Bound<'py, PyArray3<u8>>> {
        let (states, seeds) = (states.as_array(), seeds.as_array());
        let is_state = |state: &u8| usize::from(*state) < self.n_states;
        if let Some(got) = states.iter().find(|state| !is_state(state)) {
            let expected = format!("values below {}", self.n_states);
            return Err(invalid(py, "states", expected, got));
        }
        // `to_owned` would keep the strides of a broadcast array, where several worlds share their memory.
        let (mut next, seeds) = (Array3::zeros(states.dim()), seeds.to_owned());
        next.assign(&states);
        let mut dynamics = self.dynamics.clone();
        let finished = detached(py, next.len(), || {
            let mut interrupts = signals();
            for (mut world, &seed) in next.outer_iter_mut().zip(&seeds) {
                let mut states = world.to_owned();
                dynamics.step(seed, step, &mut states);
                world.assign(&states);
                if interrupts() {
                    return false;
                }
            }
            true
        });
        if !finished {
            return Err(raised());
        }
        Ok(next.into_pyarray(py))
    }
}
