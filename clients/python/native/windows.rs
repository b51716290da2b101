//! Squares of cells around robots, for the observation parts `local` and `recent`.

use crate::airspace::Given;
use crate::errors::check_memory;
use crate::flights::Flights;
use crate::model::shape_of;
use crate::refusal::invalid;
use emberwatch_model::{Airspace, Cell, Shape};
use numpy::{PyArray1, PyArray4, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray4};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyType;

type Arguments = (usize, usize, usize, usize, usize, Py<PyAny>);

/// Number of channels about the path: cells that this path has visited, cells off the grid or no-fly, and the remaining
/// share of the path. They come after the channels about the world.
const N_OF_PATH: usize = 3;

/// Maps of many robots, one row per robot. Each map has a margin around the grid, so that every window lies within the
/// map.
#[pyclass(module = "emberwatch._native")]
pub struct Windows {
    shape: Shape,
    side: usize,
    n_channels: usize,
    n_rows: usize,
    maps: Vec<u8>,
    /// The Python `Airspace` that this was built from.
    given: Py<PyAny>,
}

#[pymethods]
impl Windows {
    #[new]
    fn new(
        py: Python<'_>,
        n_rows: usize,
        height: usize,
        width: usize,
        side: usize,
        n_of_world: usize,
        given: Py<PyAny>,
    ) -> PyResult<Self> {
        let shape = shape_of(py, height, width)?;
        let airspace = given.extract::<Given<'_>>(py)?.on_grid(py, shape)?;
        let n_channels = n_of_world + N_OF_PATH;
        let n_cells = (height + side - 1).saturating_mul(width + side - 1);
        let n_bytes = n_rows.saturating_mul(n_cells).saturating_mul(n_channels);
        check_memory(py, format_args!("the windows of {n_rows} robots"), n_bytes)?;
        let mut windows = Self {
            shape,
            side,
            n_channels,
            n_rows,
            maps: vec![0; n_bytes],
            given,
        };
        windows.mark_off(&airspace);
        Ok(windows)
    }

    /// Returns the class and its arguments, for copies and pickles. A copy starts with empty maps.
    fn __reduce__<'py>(slf: &Bound<'py, Self>) -> (Bound<'py, PyType>, Arguments) {
        let this = slf.borrow();
        let (height, width) = this.shape.dim();
        let n_of_world = this.n_channels - N_OF_PATH;
        let given = this.given.clone_ref(slf.py());
        let arguments = (this.n_rows, height, width, this.side, n_of_world, given);
        (slf.get_type(), arguments)
    }

    /// Begins the paths of the rows marked in `begun`: sets their world channels to `shown`,
    /// `[n_begun, H, W, n_of_world]`, and clears their visited cells.
    fn start_paths(
        &mut self,
        begun: PyReadonlyArray1<'_, bool>,
        shown: PyReadonlyArray4<'_, u8>,
    ) -> PyResult<()> {
        let (begun, shown) = (begun.as_array(), shown.as_array());
        let (height, width) = self.shape.dim();
        let n_of_world = self.n_channels - N_OF_PATH;
        let n_begun = begun.iter().filter(|it| **it).count();
        if begun.len() != self.n_rows || shown.dim() != (n_begun, height, width, n_of_world) {
            let words = "begin: expected one flag per row, and a world for each row that begins";
            return Err(PyValueError::new_err(words));
        }
        let rows = (0..self.n_rows).filter(|&row| begun[row]);
        for (row, shown) in rows.zip(shown.outer_iter()) {
            for (y, shown) in shown.outer_iter().enumerate() {
                let first = self.index(row, Cell { row: y, col: 0 });
                let line = &mut self.maps[first..][..width * self.n_channels];
                let cells = line.chunks_exact_mut(self.n_channels);
                for (cell, shown) in cells.zip(shown.outer_iter()) {
                    (cell.iter_mut().zip(shown)).for_each(|(to, &value)| *to = value);
                    cell[n_of_world] = 0;
                }
            }
        }
        Ok(())
    }

    /// Updates the maps of the rows marked in `moved`: marks each robot's cell as visited, and clears its world
    /// channels, because no reward remains there.
    fn visit(&mut self, flights: &Flights, moved: PyReadonlyArray1<'_, bool>) -> PyResult<()> {
        let moved = moved.as_array();
        if moved.len() != self.n_rows || flights.cells().len() != self.n_rows {
            return Err(PyValueError::new_err("visit: expected one flag per row"));
        }
        let n_of_world = self.n_channels - N_OF_PATH;
        for row in (0..self.n_rows).filter(|&row| moved[row]) {
            let first = self.index(row, flights.cells()[row]);
            self.maps[first..][..n_of_world].fill(0);
            self.maps[first + n_of_world] = 255;
        }
        Ok(())
    }

    /// Returns the windows of all robots, `[n_rows, side, side, channels]`, as a new array.
    fn around<'py>(
        &self,
        py: Python<'py>,
        flights: &Flights,
    ) -> PyResult<Bound<'py, PyArray4<u8>>> {
        if flights.cells().len() != self.n_rows {
            let (expected, got) = (format!("{} rows", self.n_rows), flights.cells().len());
            return Err(invalid(py, "flights", expected, got));
        }
        let n_bytes = self.side * self.n_channels;
        let mut windows = Vec::with_capacity(self.n_rows * self.side * n_bytes);
        for (row, &at) in flights.cells().iter().enumerate() {
            let begin = windows.len();
            for y in 0..self.side {
                let first = self.padded(row, at.row + y, at.col);
                windows.extend_from_slice(&self.maps[first..][..n_bytes]);
            }
            let left = flights.share_left(row);
            let left_channel = windows[begin..].iter_mut().skip(self.n_channels - 1);
            left_channel
                .step_by(self.n_channels)
                .for_each(|to| *to = left);
        }
        let dim = [self.n_rows, self.side, self.side, self.n_channels];
        PyArray1::from_vec(py, windows).reshape(dim)
    }
}

impl Windows {
    /// Sets the channel of forbidden cells: 255 in the margin and in no-fly cells, 0 elsewhere.
    fn mark_off(&mut self, airspace: &Airspace) {
        let off = self.n_channels - 2;
        let cells = self.maps.iter_mut().skip(off).step_by(self.n_channels);
        cells.for_each(|to| *to = 255);
        for row in 0..self.n_rows {
            for index in 0..self.shape.n_cells() {
                let cell = self.shape.cell(index);
                let at = self.index(row, cell) + off;
                self.maps[at] = if airspace.is_free(cell) { 0 } else { 255 };
            }
        }
    }

    /// Returns a grid cell's index in the maps.
    fn index(&self, row: usize, cell: Cell) -> usize {
        let margin = self.side / 2;
        self.padded(row, cell.row + margin, cell.col + margin)
    }

    /// Returns a cell's index in the maps. `y` and `x` count from the corner of the margin.
    fn padded(&self, row: usize, y: usize, x: usize) -> usize {
        let (height, width) = self.shape.dim();
        let (height, width) = (height + self.side - 1, width + self.side - 1);
        ((row * height + y) * width + x) * self.n_channels
    }
}
