//! Figures of merit of runs on several worlds.

use crate::model::shape_of;
use emberwatch_belief::merit::{self, Found};
use emberwatch_model::Cell;
use emberwatch_model::path::Flight;
use numpy::ndarray::{ArrayView1, ArrayView2, Axis};
use numpy::{PyReadonlyArray1, PyReadonlyArray3};
use pyo3::prelude::*;

type Figures = (Option<u64>, Option<u32>, Option<f64>, Option<f64>, f64);

#[pyclass(module = "emberwatch._native")]
pub struct MeritTally(Vec<merit::MeritTally>);

#[pymethods]
impl MeritTally {
    #[new]
    fn new(
        py: Python<'_>,
        n_worlds: usize,
        height: usize,
        width: usize,
        target: u8,
    ) -> PyResult<Self> {
        let tally = merit::MeritTally::new(shape_of(py, height, width)?, target);
        Ok(Self(vec![tally; n_worlds]))
    }

    /// Adds one step of all worlds. Arrays have a row for each world.
    fn update(
        &mut self,
        visited: PyReadonlyArray3<'_, bool>,
        robots: PyReadonlyArray3<'_, i64>,
        n_hits: PyReadonlyArray1<'_, u32>,
        n_burning: PyReadonlyArray1<'_, u32>,
        states: Option<PyReadonlyArray3<'_, u8>>,
    ) {
        let (visited, robots) = (visited.as_array(), robots.as_array());
        let (n_hits, n_burning) = (n_hits.as_array(), n_burning.as_array());
        let states = states.as_ref().map(|states| states.as_array());
        for (world, tally) in self.0.iter_mut().enumerate() {
            let visited = visited.index_axis(Axis(0), world);
            let robots = robots.index_axis(Axis(0), world);
            let found = Found {
                n_hits: n_hits[world],
                n_burning: n_burning[world],
            };
            let states = states.map(|states| states.index_axis_move(Axis(0), world));
            let states = states.map(|states| states.as_standard_layout().into_owned());
            tally.update(&flights(visited, robots), found, states.as_ref());
        }
    }

    fn merit(&self, world: usize) -> Figures {
        let got = self.0[world].merit();
        (
            got.steps_to_detection,
            got.burning_cells_at_detection,
            got.burning_seen_share,
            got.front_distance,
            got.grid_seen_share,
        )
    }
}

/// Returns one flight for each robot, with its end cell. Visited cells count for the whole team, so the first flight
/// includes all of them.
fn flights(visited: ArrayView2<'_, bool>, robots: ArrayView2<'_, i64>) -> Vec<Flight> {
    let cells = visited.iter().enumerate().filter(|(_, visited)| **visited);
    let mut all: Vec<usize> = cells.map(|(index, _)| index).collect();
    let end = |robot: ArrayView1<'_, i64>| Flight {
        visited: std::mem::take(&mut all),
        end: Cell {
            row: robot[0] as usize,
            col: robot[1] as usize,
        },
    };
    robots.rows().into_iter().map(end).collect()
}
