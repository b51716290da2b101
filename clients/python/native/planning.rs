//! Beam search in many worlds.

use crate::refusal::invalid;
use emberwatch_belief::planning::objective::CellValues;
use emberwatch_belief::planning::{BeamSearch, Planner, PlanningProblem};
use emberwatch_protocol::Cell;
use emberwatch_protocol::path::path_to_bytes;
use numpy::ndarray::{Array2, ArrayView1};
use numpy::{IntoPyArray, PyArray2, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArray3};
use pyo3::prelude::*;

/// Widest beam, as its memory grows with it.
const MAX_WIDTH: usize = 1 << 16;

/// A path for each world: `values` are finite, `[n, H, W]`, `robots` cells of the grid, `[n, 2]`; `keys`, `[n]`, break
/// ties.
#[pyfunction]
pub fn beam_search<'py>(
    py: Python<'py>,
    values: PyReadonlyArray3<'py, f32>,
    robots: PyReadonlyArray2<'py, i64>,
    keys: PyReadonlyArray1<'py, u64>,
    n_moves: usize,
    width: usize,
) -> PyResult<Bound<'py, PyArray2<u8>>> {
    if width > MAX_WIDTH {
        return Err(invalid(py, "width", format!("at most {MAX_WIDTH}"), width));
    }
    let (values, robots, keys) = (values.as_array(), robots.as_array(), keys.as_array());
    let mut paths = Array2::zeros((values.dim().0, n_moves));
    // More states than there are beginnings of paths are never kept.
    let n_paths = 4_usize.saturating_pow(n_moves.try_into().unwrap_or(u32::MAX));
    let mut search = BeamSearch::new(width.min(n_paths));
    let worlds = values.outer_iter().zip(robots.outer_iter()).zip(keys);
    for (((values, robot), &key), mut path) in worlds.zip(paths.outer_iter_mut()) {
        py.check_signals()?;
        search.set_key(key);
        let values = CellValues::new(values.to_owned(), 0.0);
        let start = Cell {
            row: robot[0] as usize,
            col: robot[1] as usize,
        };
        let problem = PlanningProblem {
            start,
            n_moves,
            values: &values,
            seed: 0,
            step: 0,
        };
        let plan = py.detach(|| search.plan(&problem));
        path.assign(&ArrayView1::from(&path_to_bytes(&plan.moves)));
    }
    Ok(paths.into_pyarray(py))
}
