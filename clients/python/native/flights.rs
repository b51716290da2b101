//! Paths that many robots fly move by move. Each row of the arrays is about one robot.

use crate::airspace::Given;
use crate::errors::check_memory;
use crate::model::shape_of;
use crate::refusal::invalid;
use crate::windows::{N_OF_PATH, Windows};
use emberwatch_model::path::{MAX_MOVES, Move};
use emberwatch_model::{Airspace, Cell, Shape};
use numpy::ndarray::{ArrayView1, ArrayView3, Axis};
use numpy::{
    PyArray1, PyArray2, PyArray3, PyArray4, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2,
    PyReadonlyArray3, PyReadonlyArray4,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

type Arguments = (
    usize,
    usize,
    usize,
    usize,
    Option<Vec<f64>>,
    Option<Py<PyAny>>,
    Vec<(usize, usize)>,
);

/// The current path of each robot, up to its latest move. Arguments have one entry for each robot.
///
/// No method releases the interpreter lock, because another thread that used this object meanwhile would get an error.
#[pyclass(module = "emberwatch._native")]
pub struct Flights {
    shape: Shape,
    airspace: Airspace,
    given: Option<Py<PyAny>>,
    n_moves: usize,
    /// Of each hidden state, which a cell pays when it is first visited.
    reward: Option<Vec<f64>>,
    cells: Vec<Cell>,
    n_made: Vec<usize>,
    visited: Vec<u8>,
    states: Vec<u8>,
    moves: Vec<u8>,
    paid: Vec<f64>,
    windows: Vec<Windows>,
}

#[pymethods]
impl Flights {
    /// `windows` lists the squares of cells to show around each robot: their sides, and their numbers of channels about
    /// the world.
    #[new]
    #[pyo3(signature = (n_rows, height, width, n_moves, reward, airspace=None, windows=vec![]))]
    #[expect(clippy::too_many_arguments, reason = "the parts of a path")]
    fn new(
        py: Python<'_>,
        n_rows: usize,
        height: usize,
        width: usize,
        n_moves: usize,
        reward: Option<Vec<f64>>,
        airspace: Option<Py<PyAny>>,
        windows: Vec<(usize, usize)>,
    ) -> PyResult<Self> {
        let shape = shape_of(py, height, width)?;
        let within = match &airspace {
            None => Airspace::open(shape),
            Some(given) => given.extract::<Given<'_>>(py)?.on_grid(py, shape)?,
        };
        if !(1..=MAX_MOVES).contains(&n_moves) {
            let expected = format!("an integer within 1 to {MAX_MOVES}");
            return Err(invalid(py, "n_moves", expected, n_moves));
        }
        let of_windows = windows.iter();
        let of_windows = of_windows.map(|&(side, n)| Windows::n_bytes(n_rows, shape, side, n));
        let n_bytes = n_rows.saturating_mul(2 * shape.n_cells() + n_moves);
        let n_bytes = of_windows.fold(n_bytes, usize::saturating_add);
        check_memory(py, format_args!("the flights of {n_rows} robots"), n_bytes)?;
        Ok(Self {
            shape,
            given: airspace,
            n_moves,
            reward,
            cells: vec![Cell { row: 0, col: 0 }; n_rows],
            n_made: vec![0; n_rows],
            visited: vec![0; n_rows * shape.n_cells()],
            states: vec![0; n_rows * shape.n_cells()],
            moves: vec![0; n_rows * n_moves],
            paid: vec![0.0; n_rows],
            windows: windows
                .iter()
                .map(|&(side, n_of_world)| Windows::new(n_rows, &within, side, n_of_world))
                .collect(),
            airspace: within,
        })
    }

    /// Returns the constructor's arguments, for copies and pickles, which start without paths.
    fn __getnewargs__(&self, py: Python<'_>) -> Arguments {
        let (height, width) = self.shape.dim();
        let reward = self.reward.clone();
        let given = self.given.as_ref().map(|it| it.clone_ref(py));
        let windows = self.windows.iter().map(Windows::dim).collect();
        let n_rows = self.cells.len();
        (n_rows, height, width, self.n_moves, reward, given, windows)
    }

    #[getter]
    fn robots<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<i64>>> {
        let cells = self.cells.iter();
        let flat = cells.flat_map(|cell| [cell.row as i64, cell.col as i64]);
        PyArray1::from_iter(py, flat).reshape([self.cells.len(), 2])
    }

    #[getter]
    fn n_made<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<i64>> {
        PyArray1::from_iter(py, self.n_made.iter().map(|&n| n as i64))
    }

    /// 255 in visited cells, otherwise 0, `[n_rows, H, W]`.
    #[getter]
    fn visited<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<u8>>> {
        let (height, width) = self.shape.dim();
        PyArray1::from_slice(py, &self.visited).reshape([self.cells.len(), height, width])
    }

    #[getter]
    fn paid<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_slice(py, &self.paid)
    }

    /// The action masks, `[n_rows, 4]`: 1 for each move that takes a robot to another cell, otherwise 0. If no move
    /// does, the robot's whole mask is 1.
    #[getter]
    fn masks<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<i8>>> {
        let mut masks = Vec::with_capacity(self.cells.len() * Move::ALL.len());
        for &cell in &self.cells {
            let leads_on = Move::ALL.map(|step| self.airspace.after(step, cell) != cell);
            let is_stuck = leads_on == [false; Move::ALL.len()];
            masks.extend(leads_on.map(|leads| i8::from(leads || is_stuck)));
        }
        PyArray1::from_vec(py, masks).reshape([self.cells.len(), Move::ALL.len()])
    }

    fn start_paths(
        &mut self,
        py: Python<'_>,
        begun: PyReadonlyArray1<'_, bool>,
        robots: PyReadonlyArray2<'_, i64>,
        states: Option<PyReadonlyArray3<'_, u8>>,
    ) -> PyResult<()> {
        let (begun, robots) = (begun.as_array(), robots.as_array());
        let (height, width) = self.shape.dim();
        let states = states.as_ref().map(|states| states.as_array());
        let dim = (self.cells.len(), height, width);
        if let Some(got) = states.map(|it| it.dim()).filter(|&got| got != dim) {
            let (expected, got) = (format!("shape {dim:?}"), format!("{got:?}"));
            return Err(invalid(py, "states", expected, got));
        }
        for row in (0..begun.len()).filter(|&row| begun[row]) {
            let cell = [robots[[row, 0]], robots[[row, 1]]].map(|at| usize::try_from(at).ok());
            let cell = match cell {
                [Some(row), Some(col)] if row < height && col < width => Cell { row, col },
                _ => return Err(PyValueError::new_err("begin: expected robots on the grid")),
            };
            self.cells[row] = cell;
            self.n_made[row] = 0;
            self.paid[row] = 0.0;
        }
        self.enter(begun, states);
        Ok(())
    }

    fn completes<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<bool>> {
        PyArray1::from_iter(py, self.n_made.iter().map(|n| n + 1 == self.n_moves))
    }

    /// Returns the paths, `[n_rows, n_moves]`, with `actions` as their last moves.
    fn paths<'py>(
        &self,
        py: Python<'py>,
        actions: PyReadonlyArray1<'_, u8>,
    ) -> PyResult<Bound<'py, PyArray2<u8>>> {
        let mut paths = self.moves.clone();
        let rows = paths.chunks_exact_mut(self.n_moves);
        for (row, &action) in rows.zip(actions.as_array()) {
            row[self.n_moves - 1] = action;
        }
        PyArray1::from_vec(py, paths).reshape([self.cells.len(), self.n_moves])
    }

    fn made<'py>(&self, py: Python<'py>, row: usize) -> Bound<'py, PyArray1<u8>> {
        let made = &self.moves[row * self.n_moves..][..self.n_made[row]];
        PyArray1::from_slice(py, made)
    }

    /// Sets the channels about the world in the windows of the rows marked in `begun`, whose paths begin, to `shown`,
    /// `[n_begun, H, W, n_of_world]`.
    fn show(
        &mut self,
        windows: usize,
        begun: PyReadonlyArray1<'_, bool>,
        shown: PyReadonlyArray4<'_, u8>,
    ) {
        let begun = begun.as_array();
        let rows = (0..begun.len()).filter(|&row| begun[row]);
        for (row, shown) in rows.zip(shown.as_array().outer_iter()) {
            self.windows[windows].show(row, shown);
        }
    }

    /// Returns windows, `[n_rows, side, side, channels]`, as a new array.
    fn around<'py>(&self, py: Python<'py>, windows: usize) -> PyResult<Bound<'py, PyArray4<u8>>> {
        let (n_rows, windows) = (self.cells.len(), &self.windows[windows]);
        let (side, n_of_world) = windows.dim();
        let dim = [n_rows, side, side, n_of_world + N_OF_PATH];
        let mut out = Vec::with_capacity(dim.iter().product());
        for (row, &robot) in self.cells.iter().enumerate() {
            windows.append(row, robot, self.share_left(row), &mut out);
        }
        PyArray1::from_vec(py, out).reshape(dim)
    }

    /// Makes one move in each row marked in `moved`. Each action is a move, 0 to 3. Returns the reward of each row.
    fn r#move<'py>(
        &mut self,
        py: Python<'py>,
        moved: PyReadonlyArray1<'_, bool>,
        actions: PyReadonlyArray1<'_, u8>,
    ) -> Bound<'py, PyArray1<f64>> {
        let mut paid = vec![0.0; self.cells.len()];
        let rows = moved.as_array();
        for (row, &action) in actions.as_array().iter().enumerate() {
            if rows[row] {
                paid[row] = self.make_move(row, action);
            }
        }
        PyArray1::from_vec(py, paid)
    }
}

impl Flights {
    /// Returns the share of a path's moves that remain, times 255.
    fn share_left(&self, row: usize) -> u8 {
        let made = self.n_made[row] as f64 / self.n_moves as f64;
        (255.0 * (1.0 - made)).round_ties_even() as u8
    }

    fn enter(&mut self, begun: ArrayView1<'_, bool>, states: Option<ArrayView3<'_, u8>>) {
        let n_cells = self.shape.n_cells();
        for row in (0..begun.len()).filter(|&row| begun[row]) {
            let cells = row * n_cells..(row + 1) * n_cells;
            self.visited[cells.clone()].fill(0);
            if let Some(states) = states {
                let own = states.index_axis_move(Axis(0), row);
                let kept = self.states[cells].iter_mut();
                kept.zip(own).for_each(|(kept, &state)| *kept = state);
            }
        }
    }

    fn make_move(&mut self, row: usize, action: u8) -> f64 {
        self.moves[row * self.n_moves + self.n_made[row]] = action;
        self.n_made[row] += 1;
        let step = Move::from_low_bits(action.into());
        let cell = self.airspace.after(step, self.cells[row]);
        self.cells[row] = cell;
        for windows in &mut self.windows {
            windows.visit(row, cell);
        }
        let at = row * self.shape.n_cells() + self.shape.index(cell);
        let is_new = std::mem::replace(&mut self.visited[at], 255) == 0;
        let reward = self.reward.as_ref().filter(|_| is_new);
        let paid = reward.and_then(|reward| reward.get(usize::from(self.states[at])));
        let paid = paid.copied().unwrap_or_default();
        self.paid[row] += paid;
        paid
    }
}
