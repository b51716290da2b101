//! Makes the records of `emberwatch/client` (frozen dataclasses and named tuples in Python, which say what each field
//! means) from replies, published samples and results.

use crate::airspace;
use crate::errors::bad_answer;
use emberwatch_messages::agent_belief::AgentBelief;
use emberwatch_messages::control::{ServerInfo, ServerStatus, WorldInfo};
use emberwatch_messages::left_belief::LeftBelief;
use emberwatch_messages::message::{
    AgentHeader, FrameHeader, RobotResult, TruthHeader, WorldResult,
};
use emberwatch_messages::payload::{split_frame_payload, truth_states};
use emberwatch_messages::sample::Sample;
use emberwatch_model::Grid;
use numpy::{IntoPyArray, PyArray1, PyArrayMethods};
use pyo3::IntoPyObjectExt;
use pyo3::prelude::*;
use pyo3::types::{IntoPyDict, PyBytes, PyDict, PyTuple};
use serde::Serialize;
use serde_json::Value;

pub fn view<'py>(bytes: &Bound<'py, PyArray1<u8>>, dtype: &str) -> PyResult<Bound<'py, PyAny>> {
    bytes.call_method1("view", (of(bytes.py(), "wire", dtype)?,))
}

pub fn step_result<'py>(
    py: Python<'py>,
    world: &WorldResult,
    robot: &RobotResult,
) -> PyResult<Bound<'py, PyAny>> {
    let results = (world_result(py, world)?, robot_result(py, robot)?);
    of(py, "wire", "StepResult")?.call1(results)
}

fn world_result<'py>(py: Python<'py>, it: &WorldResult) -> PyResult<Bound<'py, PyAny>> {
    of(py, "wire", "WorldResult")?.call1((
        it.step,
        it.seed,
        it.episode,
        it.reward,
        it.hovered,
        it.late,
        it.n_target_cells,
        it.n_visited,
        it.n_hits,
        it.terminated,
        it.truncated,
    ))
}

fn robot_result<'py>(py: Python<'py>, it: &RobotResult) -> PyResult<Bound<'py, PyAny>> {
    of(py, "wire", "RobotResult")?.call1((
        it.reward,
        it.marginal,
        it.n_visited,
        it.n_hits,
        it.start_row,
        it.start_col,
        it.row,
        it.col,
        it.coverage,
        it.n_moves,
    ))
}

pub fn server_info<'py>(py: Python<'py>, info: &ServerInfo) -> PyResult<Bound<'py, PyAny>> {
    let fields = fields(py, info)?;
    let airspace = info
        .airspace()
        .map_err(|problem| bad_answer(py, &problem))?;
    let no_fly = airspace.no_fly().map(|map| &**map);
    let airspace = airspace::python(py, airspace.radius(), no_fly)?;
    fields.set_item("airspace", airspace)?;
    if let Some(recorded) = &info.recorded_world {
        fields.set_item("recorded_world", record(py, "RecordedWorld", recorded)?)?;
    }
    made(py, "ServerInfo", &fields)
}

pub fn status<'py>(py: Python<'py>, status: &ServerStatus) -> PyResult<Bound<'py, PyAny>> {
    let fields = fields(py, status)?;
    let worlds = status.worlds.iter();
    let worlds: PyResult<Vec<_>> = worlds.map(|it| record(py, "WorldStatus", it)).collect();
    fields.set_item("worlds", PyTuple::new(py, worlds?)?)?;
    made(py, "ServerStatus", &fields)
}

pub fn worlds<'py>(py: Python<'py>, worlds: &[WorldInfo]) -> PyResult<Bound<'py, PyTuple>> {
    let worlds: PyResult<Vec<_>> = worlds
        .iter()
        .map(|it| record(py, "WorldInfo", it))
        .collect();
    PyTuple::new(py, worlds?)
}

pub fn left_belief<'py>(py: Python<'py>, left: &LeftBelief) -> PyResult<Bound<'py, PyAny>> {
    let (info, bytes) = (&left.info, PyBytes::new(py, &left.bytes));
    of(py, "replies", "LeftBelief")?.call1((&info.kind, info.episode, info.step, bytes))
}

pub fn frame<'py>(
    py: Python<'py>,
    sample: &Sample<FrameHeader>,
    n_lost: u64,
) -> PyResult<Bound<'py, PyAny>> {
    let header = &sample.header;
    let shape = [header.height as usize, header.width as usize];
    let parts = split_frame_payload(header, &sample.payload);
    let mut robots = Vec::new();
    for robot in parts.map_err(|problem| bad_answer(py, &problem))? {
        let fields = PyDict::new(py);
        fields.set_item("result", robot_result(py, &robot.result)?)?;
        let frame = PyArray1::from_slice(py, robot.frame).reshape(shape)?;
        fields.set_item("frame", frame)?;
        fields.set_item("path", PyArray1::from_slice(py, robot.path))?;
        robots.push(sample_of(py, "RobotFrame", &fields)?);
    }
    let fields = PyDict::new(py);
    fields.set_item("world", header.world)?;
    fields.set_item("result", world_result(py, &header.result)?)?;
    fields.set_item("robots", PyTuple::new(py, robots)?)?;
    fields.set_item("n_lost", n_lost)?;
    sample_of(py, "Frame", &fields)
}

pub fn truth<'py>(
    py: Python<'py>,
    sample: &Sample<TruthHeader>,
    n_lost: u64,
) -> PyResult<Bound<'py, PyAny>> {
    let header = &sample.header;
    let states = truth_states(sample).map_err(|problem| bad_answer(py, &problem))?;
    let moment = (header.episode, header.step, header.seed);
    truth_from(py, (header.world, moment), states, n_lost)
}

pub fn truth_of<'py>(
    py: Python<'py>,
    world: u32,
    result: &WorldResult,
    states: Grid<u8>,
) -> PyResult<Bound<'py, PyAny>> {
    let moment = (result.episode, result.step, result.seed);
    truth_from(py, (world, moment), states, 0)
}

fn truth_from<'py>(
    py: Python<'py>,
    (world, (episode, step, seed)): (u32, (u64, u64, u64)),
    states: Grid<u8>,
    n_lost: u64,
) -> PyResult<Bound<'py, PyAny>> {
    let numbers = [
        ("episode", episode),
        ("step", step),
        ("seed", seed),
        ("n_lost", n_lost),
    ];
    let fields = numbers.into_py_dict(py)?;
    fields.set_item("world", world)?;
    fields.set_item("states", states.into_pyarray(py))?;
    sample_of(py, "Truth", &fields)
}

pub fn outlook<'py>(
    py: Python<'py>,
    sample: &Sample<AgentHeader>,
    n_lost: u64,
) -> PyResult<Bound<'py, PyAny>> {
    let checked = AgentBelief::try_from(sample);
    let checked = checked.map_err(|error| bad_answer(py, &error.to_string()))?;
    let header = checked.header;
    let fields = fields(py, &checked.intent)?;
    let numbers = [
        ("episode", header.episode),
        ("step", header.step),
        ("seed", header.seed),
        ("n_lost", n_lost),
        ("world", header.world.into()),
        ("pid", header.pid.into()),
    ];
    for (name, number) in numbers {
        fields.set_item(name, number)?;
    }
    fields.set_item("belief", checked.belief.into_pyarray(py))?;
    let end = header.first_robot.saturating_add(header.n_robots);
    let robots = pyo3::types::PyRange::new(py, header.first_robot as isize, end as isize)?;
    fields.set_item("robots", robots)?;
    sample_of(py, "Outlook", &fields)
}

fn record<'py>(
    py: Python<'py>,
    class: &str,
    reply: &impl Serialize,
) -> PyResult<Bound<'py, PyAny>> {
    made(py, class, &fields(py, reply)?)
}

fn made<'py>(
    py: Python<'py>,
    class: &str,
    fields: &Bound<'py, PyDict>,
) -> PyResult<Bound<'py, PyAny>> {
    of(py, "replies", class)?.call((), Some(fields))
}

fn sample_of<'py>(
    py: Python<'py>,
    class: &str,
    fields: &Bound<'py, PyDict>,
) -> PyResult<Bound<'py, PyAny>> {
    of(py, "observer", class)?.call((), Some(fields))
}

pub fn of<'py>(py: Python<'py>, module: &str, name: &str) -> PyResult<Bound<'py, PyAny>> {
    py.import("emberwatch.client")?
        .getattr(module)?
        .getattr(name)
}

/// Returns the JSON keys of a reply as a dictionary; arrays become tuples.
fn fields<'py>(py: Python<'py>, reply: &impl Serialize) -> PyResult<Bound<'py, PyDict>> {
    let value = serde_json::to_value(reply).expect("invariant: replies serialise");
    Ok(python(py, value)?.cast_into()?)
}

fn python(py: Python<'_>, value: Value) -> PyResult<Bound<'_, PyAny>> {
    match value {
        Value::Null => Ok(py.None().into_bound(py)),
        Value::Bool(is_true) => is_true.into_bound_py_any(py),
        Value::Number(number) => match (number.as_u64(), number.as_f64()) {
            (Some(integer), _) => integer.into_bound_py_any(py),
            (None, float) => float.into_bound_py_any(py),
        },
        Value::String(text) => text.into_bound_py_any(py),
        Value::Array(values) => {
            let values: PyResult<Vec<_>> = values.into_iter().map(|it| python(py, it)).collect();
            Ok(PyTuple::new(py, values?)?.into_any())
        }
        Value::Object(keys) => {
            let fields = PyDict::new(py);
            for (key, value) in keys {
                fields.set_item(key, python(py, value)?)?;
            }
            Ok(fields.into_any())
        }
    }
}
