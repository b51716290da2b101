//! Beam search in many worlds at once.

use crate::airspace::Given;
use crate::errors::{check_memory, raised};
use crate::model::shape_of;
use crate::refusal::invalid;
use crate::threads::signals;
use emberwatch_belief::planning::objective::CellValues;
use emberwatch_belief::planning::{BeamSearch, PlanningProblem};
use emberwatch_model::path::path_to_bytes;
use emberwatch_model::{Airspace, Cell, Shape};
use numpy::ndarray::{Array2, ArrayView1};
use numpy::{IntoPyArray, PyArray2, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArray3};
use pyo3::prelude::*;

const MAX_BEAM_BYTES: usize = 1 << 32;

/// Plans a path for each world. `values`, `[n, H, W]`, are finite; `robots` has shape `[n, 2]`; `keys`, `[n]`, break
/// ties. Python has checked that `n_moves` and `width` are in range.
#[pyfunction]
#[pyo3(signature = (values, robots, keys, n_moves, width, airspace=None))]
pub fn beam_search<'py>(
    py: Python<'py>,
    values: PyReadonlyArray3<'py, f32>,
    robots: PyReadonlyArray2<'py, i64>,
    keys: PyReadonlyArray1<'py, u64>,
    n_moves: usize,
    width: usize,
    airspace: Option<Given<'py>>,
) -> PyResult<Bound<'py, PyArray2<u8>>> {
    let (values, robots, keys) = (values.as_array(), robots.as_array(), keys.as_array());
    let (n_worlds, height, n_cols) = values.dim();
    let shape = shape_of(py, height, n_cols)?;
    let airspace = match airspace {
        None => Airspace::open(shape),
        Some(given) => given.on_grid(py, shape)?,
    };
    // A beam never holds more states than there are paths, 4 to the power of `n_moves`.
    let n_paths = 4_usize.saturating_pow(n_moves as u32);
    check(py, shape, n_moves, (width, width.min(n_paths)))?;
    let mut paths = Array2::zeros((n_worlds, n_moves));
    let mut search = BeamSearch::new(width.min(n_paths));
    let mut interrupts = signals();
    let worlds = values.outer_iter().zip(robots.outer_iter()).zip(keys);
    for (((values, robot), &key), mut path) in worlds.zip(paths.outer_iter_mut()) {
        search.set_key(key);
        let values = CellValues::new(values.to_owned(), 0.0).within(&airspace, None);
        let start = Cell {
            row: robot[0] as usize,
            col: robot[1] as usize,
        };
        if !shape.contains(start) || !airspace.is_free(start) {
            let expected = format!("cells of a {shape} grid where they may fly");
            return Err(invalid(py, "robots", expected, robot));
        }
        let problem = PlanningProblem {
            start,
            n_moves,
            values: &values,
            seed: 0,
            step: 0,
        };
        let plan = py.detach(|| search.plan_unless(&problem, &mut interrupts));
        let plan = plan.ok_or_else(raised)?;
        path.assign(&ArrayView1::from(&path_to_bytes(&plan.moves)));
    }
    Ok(paths.into_pyarray(py))
}

fn check(
    py: Python<'_>,
    shape: Shape,
    n_moves: usize,
    (width, n_kept): (usize, usize),
) -> PyResult<()> {
    let reach = |side: usize| side.min(2 * n_moves + 1);
    let set_bytes = (reach(shape.height()) * reach(shape.width())).div_ceil(64) * 8;
    // Each state has two sets of cells, for before and after a move, and one link per move to the previous state.
    let state_bytes = 2 * set_bytes + n_moves * 8;
    let widest = MAX_BEAM_BYTES / state_bytes;
    if width > widest {
        let expected = format!("an integer within 1 to {widest}");
        return Err(invalid(py, "width", expected, width));
    }
    check_memory(
        py,
        format_args!("a beam of width {width}"),
        n_kept * state_bytes,
    )
}
