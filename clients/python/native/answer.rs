//! The answer to a step: the results of worlds and robots, and the frames.

use crate::records;
use crate::refusal::invalid;
use emberwatch_messages::message::{
    FLAG_TEAM_FRAMES, RobotResult, StepReply, WorldResult, worlds_of,
};
use emberwatch_messages::payload::{ROBOT_BYTES, WORLD_BYTES};
use emberwatch_model::Shape;
use numpy::ndarray::arr2;
use numpy::{PyArray1, PyArray2, PyArray3, PyArrayMethods, PyReadonlyArray1};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::PySlice;
use std::ops::Range;

pub const RESULT_BYTES: usize = WORLD_BYTES + ROBOT_BYTES;

/// Results of one robot's step: reward, terminated, truncated, step, number of distinct cells visited, and the robot's
/// row and column as `[1, 2]`.
type Numbers<'py> = (f64, bool, bool, u64, u32, Bound<'py, PyArray2<i64>>);

type Columns<'py> = (
    Bound<'py, PyArray1<f64>>,
    Bound<'py, PyArray1<bool>>,
    Bound<'py, PyArray1<bool>>,
    Bound<'py, PyArray1<i64>>,
    Bound<'py, PyArray1<i64>>,
    Bound<'py, PyArray2<i64>>,
    bool,
);

/// The answer to a step or an observation: results and frames of consecutive robots.
///
/// Attributes:
///     first_robot: The number of the first robot; robot r of world w has number w R + r.
///     simulation_nanos: Nanoseconds that the simulation took.
///     frames: The frame of each robot, `(n_robots, H, W)`: observed values, 255 in unobserved
///         cells. If team frames were requested: the frame of each world's team,
///         `(n_worlds, H, W)`. The array is a copy that you may write to.
///     worlds: One `WorldResult` for each world, `(n_worlds,)` of `WORLD_DTYPE`.
///     robots: One `RobotResult` for each robot, `(n_robots,)` of `ROBOT_DTYPE`.
///     results: One `StepResult` for each robot, `(n_robots,)` of `RESULT_DTYPE`; a new array.
///     world_of: The index in `worlds` of each robot's world, `(n_robots,)`.
#[pyclass(frozen, module = "emberwatch")]
pub struct StepAnswer {
    team: u32,
    #[pyo3(get)]
    first_robot: u32,
    n_robots: u32,
    #[pyo3(get)]
    simulation_nanos: u64,
    /// Number of frames, height, width.
    dim: [usize; 3],
    payload: Py<PyArray1<u8>>,
    frames: PyOnceLock<Py<PyArray3<u8>>>,
    first: (WorldResult, RobotResult),
}

#[pymethods]
impl StepAnswer {
    #[getter]
    fn frames<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<u8>>> {
        let made = self.frames.get_or_try_init(py, || {
            let frames = self.slice(py, self.head()..self.n_bytes())?;
            PyResult::Ok(frames.reshape(self.dim)?.unbind())
        })?;
        Ok(made.bind(py).clone())
    }

    #[getter]
    fn worlds<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        records::view(&self.slice(py, 0..self.worlds_end())?, "WORLD_DTYPE")
    }

    #[getter]
    fn robots<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        records::view(
            &self.slice(py, self.worlds_end()..self.head())?,
            "ROBOT_DTYPE",
        )
    }

    #[getter]
    fn results<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let payload = self.bytes(py)?;
        let (worlds, robots) = payload.as_slice()?[..self.head()].split_at(self.worlds_end());
        let mut results = Vec::with_capacity(self.n_robots as usize * RESULT_BYTES);
        for (index, robot) in robots.chunks_exact(ROBOT_BYTES).enumerate() {
            results.extend_from_slice(
                &worlds[self.world_of_robot(index) * WORLD_BYTES..][..WORLD_BYTES],
            );
            results.extend_from_slice(robot);
        }
        records::view(&PyArray1::from_vec(py, results), "RESULT_DTYPE")
    }

    #[getter]
    fn world_of<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<i64>> {
        let robots = 0..self.n_robots as usize;
        PyArray1::from_iter(py, robots.map(|index| self.world_of_robot(index) as i64))
    }

    /// Returns the `StepResult` of one robot; `index` 0 is the first robot.
    #[pyo3(signature = (index=0))]
    fn result<'py>(&self, py: Python<'py>, index: usize) -> PyResult<Bound<'py, PyAny>> {
        let (world, robot) = self.results_of(py, index)?;
        records::step_result(py, &world, &robot)
    }

    fn __repr__(&self, py: Python<'_>) -> PyResult<String> {
        let first = self.result(py, 0)?.repr()?;
        Ok(format!(
            "<StepAnswer of robots {} to {}, the first: {first}>",
            self.first_robot,
            self.first_robot + self.n_robots - 1
        ))
    }

    /// Returns the first robot's results as numbers, for environments.
    ///
    /// The tuple has reward, terminated, truncated, step, number of distinct visited cells, and
    /// cell (a new array, `(1, 2)`). `pays` chooses the reward: 0 share, 1 team, 2 marginal.
    fn numbers<'py>(&self, py: Python<'py>, pays: u8) -> Numbers<'py> {
        let (world, robot) = self.first;
        (
            paid(pays, &world, &robot),
            world.terminated != 0,
            world.truncated != 0,
            world.step,
            robot.n_visited,
            PyArray2::from_owned_array(py, arr2(&[[i64::from(robot.row), i64::from(robot.col)]])),
        )
    }
}

impl StepAnswer {
    pub fn of(
        py: Python<'_>,
        team: u32,
        shape: Shape,
        reply: &StepReply,
        payload: Vec<u8>,
    ) -> Self {
        let n_worlds = worlds_of(reply.first_robot, reply.n_robots, team).len();
        let robot = &payload[n_worlds * WORLD_BYTES..][..ROBOT_BYTES];
        let first = (
            bytemuck::pod_read_unaligned(&payload[..WORLD_BYTES]),
            bytemuck::pod_read_unaligned(robot),
        );
        let n_frames = match reply.flags & FLAG_TEAM_FRAMES {
            0 => reply.n_robots as usize,
            _ => n_worlds,
        };
        Self {
            team: team.max(1),
            first_robot: reply.first_robot,
            n_robots: reply.n_robots,
            simulation_nanos: reply.simulation_nanos,
            dim: [n_frames, shape.height(), shape.width()],
            payload: PyArray1::from_vec(py, payload).unbind(),
            frames: PyOnceLock::new(),
            first,
        }
    }

    fn worlds_end(&self) -> usize {
        worlds_of(self.first_robot, self.n_robots, self.team).len() * WORLD_BYTES
    }

    fn head(&self) -> usize {
        self.worlds_end() + self.n_robots as usize * ROBOT_BYTES
    }

    fn n_bytes(&self) -> usize {
        self.head() + self.dim.iter().product::<usize>()
    }

    fn world_of_robot(&self, index: usize) -> usize {
        let first = self.first_robot / self.team;
        ((self.first_robot + index as u32) / self.team - first) as usize
    }

    fn bytes<'py>(&self, py: Python<'py>) -> PyResult<PyReadonlyArray1<'py, u8>> {
        Ok(self.payload.bind(py).try_readonly()?)
    }

    fn slice<'py>(
        &self,
        py: Python<'py>,
        bytes: Range<usize>,
    ) -> PyResult<Bound<'py, PyArray1<u8>>> {
        // PyO3's `PySlice::new` leaks its numbers.
        let slice = py.get_type::<PySlice>();
        let slice = slice.call1((bytes.start, bytes.end))?;
        Ok(self.payload.bind(py).get_item(slice)?.cast_into()?)
    }

    fn results_of(&self, py: Python<'_>, index: usize) -> PyResult<(WorldResult, RobotResult)> {
        if index >= self.n_robots as usize {
            let expected = format!("0 to {}", self.n_robots - 1);
            return Err(invalid(py, "index", expected, index));
        }
        let payload = self.bytes(py)?;
        let payload = payload.as_slice()?;
        let world = &payload[self.world_of_robot(index) * WORLD_BYTES..][..WORLD_BYTES];
        let robot = &payload[self.worlds_end() + index * ROBOT_BYTES..][..ROBOT_BYTES];
        Ok((
            bytemuck::pod_read_unaligned(world),
            bytemuck::pod_read_unaligned(robot),
        ))
    }
}

/// Decodes the results of all robots' steps from bytes of `wire.RESULT_DTYPE`. `pays`: see `StepAnswer.numbers`.
#[pyfunction]
pub fn columns<'py>(
    py: Python<'py>,
    results: PyReadonlyArray1<'py, u8>,
    pays: u8,
) -> PyResult<Columns<'py>> {
    let results = results.as_slice()?.chunks_exact(RESULT_BYTES);
    let n = results.len();
    let (mut rewards, mut cells) = (Vec::with_capacity(n), Vec::with_capacity(2 * n));
    let (mut terminated, mut truncated) = (Vec::with_capacity(n), Vec::with_capacity(n));
    let (mut steps, mut n_visited) = (Vec::with_capacity(n), Vec::with_capacity(n));
    for result in results {
        let (world, robot) = result.split_at(WORLD_BYTES);
        let world: WorldResult = bytemuck::pod_read_unaligned(world);
        let robot: RobotResult = bytemuck::pod_read_unaligned(robot);
        rewards.push(paid(pays, &world, &robot));
        terminated.push(world.terminated != 0);
        truncated.push(world.truncated != 0);
        steps.push(world.step as i64);
        n_visited.push(robot.n_visited.into());
        cells.extend([i64::from(robot.row), i64::from(robot.col)]);
    }
    let is_over = terminated.contains(&true) || truncated.contains(&true);
    Ok((
        PyArray1::from_vec(py, rewards),
        PyArray1::from_vec(py, terminated),
        PyArray1::from_vec(py, truncated),
        PyArray1::from_vec(py, steps),
        PyArray1::from_vec(py, n_visited),
        PyArray1::from_vec(py, cells).reshape([n, 2])?,
        is_over,
    ))
}

fn paid(pays: u8, world: &WorldResult, robot: &RobotResult) -> f64 {
    match pays {
        0 => robot.reward,
        1 => world.reward,
        _ => robot.marginal,
    }
}
