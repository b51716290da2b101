//! Conversion of published samples to the fields of `Frame`, `Truth` and `Outlook` in `emberwatch/client/observer.py`.

use emberwatch_messages::agent_belief::AgentBelief;
use emberwatch_messages::message::{
    AgentHeader, FrameHeader, RobotResult, TruthHeader, VERSION, WorldResult,
};
use emberwatch_messages::payload::split_frame_payload;
use emberwatch_messages::sample::Sample;
use numpy::ndarray::Array2;
use numpy::{PyArray1, PyArray2, PyArray3, PyArrayMethods};
use pyo3::prelude::*;

pub type WorldRow = (u64, u64, u64, f64, u64, u64, u32, u32, u32, u16, u16);
pub type Robot = (f64, f64, u32, u32, u32, u32, u32, u32, u32, u32);

/// A robot's result, its frame, and the path that it flew.
type RobotFrame<'py> = (Robot, Bound<'py, PyArray2<u8>>, Bound<'py, PyArray1<u8>>);

#[derive(IntoPyObject)]
pub struct Frame<'py> {
    world: u32,
    result: WorldRow,
    robots: Vec<RobotFrame<'py>>,
    n_lost: u64,
}

#[derive(IntoPyObject)]
pub struct Truth<'py> {
    world: u32,
    episode: u64,
    step: u64,
    seed: u64,
    states: Bound<'py, PyArray2<u8>>,
    n_lost: u64,
}

#[derive(IntoPyObject)]
pub struct Outlook<'py> {
    world: u32,
    episode: u64,
    step: u64,
    seed: u64,
    belief: Bound<'py, PyArray3<f32>>,
    states: Vec<String>,
    policy: String,
    belief_from: String,
    objective: String,
    plan_millis: f64,
    pid: u32,
    robots: (u32, u32),
    n_lost: u64,
}

/// The fields that the headers of all samples share.
pub trait Published {
    fn version(&self) -> u32;
    fn world(&self) -> u32;
    fn sequence(&self) -> u64;
    /// The id of the process that numbers the samples; 0 on channels where only the server publishes.
    fn publisher(&self) -> u32;
}

macro_rules! published {
    ($header:ty, $publisher:expr) => {
        impl Published for $header {
            fn version(&self) -> u32 {
                self.version
            }

            fn world(&self) -> u32 {
                self.world
            }

            fn sequence(&self) -> u64 {
                self.sequence
            }

            fn publisher(&self) -> u32 {
                let publisher: fn(&Self) -> u32 = $publisher;
                publisher(self)
            }
        }
    };
}

published!(FrameHeader, |_| 0);
published!(TruthHeader, |_| 0);
published!(AgentHeader, |header| header.pid);

/// Checks that a sample has the protocol version of this package.
pub fn check_version(header: &impl Published) -> Result<(), String> {
    match header.version() {
        VERSION => Ok(()),
        got => Err(format!("expected version {VERSION}, got {got}")),
    }
}

pub fn frame<'py>(
    py: Python<'py>,
    sample: &Sample<FrameHeader>,
    n_lost: u64,
) -> Result<Frame<'py>, String> {
    let header = &sample.header;
    let shape = [header.height as usize, header.width as usize];
    let mut robots = Vec::new();
    for robot in split_frame_payload(header, &sample.payload)? {
        let frame = PyArray1::from_slice(py, robot.frame).reshape(shape);
        let frame = frame.map_err(|error| error.to_string())?;
        let path = PyArray1::from_slice(py, robot.path);
        robots.push((of_robot(&robot.result), frame, path));
    }
    Ok(Frame {
        world: header.world,
        result: of_world(&header.result),
        robots,
        n_lost,
    })
}

pub fn truth<'py>(
    py: Python<'py>,
    sample: &Sample<TruthHeader>,
    n_lost: u64,
) -> Result<Truth<'py>, String> {
    let header = sample.header;
    let (height, width) = (header.height as usize, header.width as usize);
    let (expected, got) = (height.saturating_mul(width), sample.payload.len());
    if got != expected {
        return Err(format!("expected {expected} bytes, got {got}"));
    }
    let states = PyArray1::from_slice(py, &sample.payload).reshape([height, width]);
    Ok(Truth {
        world: header.world,
        episode: header.episode,
        step: header.step,
        seed: header.seed,
        states: states.map_err(|error| error.to_string())?,
        n_lost,
    })
}

/// Returns the hidden states of a world in this process.
pub fn truth_of<'py>(
    py: Python<'py>,
    world: usize,
    result: &WorldResult,
    states: Array2<u8>,
) -> Truth<'py> {
    Truth {
        world: world as u32,
        episode: result.episode,
        step: result.step,
        seed: result.seed,
        states: PyArray2::from_owned_array(py, states),
        n_lost: 0,
    }
}

pub fn outlook<'py>(
    py: Python<'py>,
    sample: &Sample<AgentHeader>,
    n_lost: u64,
) -> Result<Outlook<'py>, String> {
    let checked = AgentBelief::try_from(sample).map_err(|error| error.to_string())?;
    let (header, intent) = (checked.header, checked.intent);
    Ok(Outlook {
        world: header.world,
        episode: header.episode,
        step: header.step,
        seed: header.seed,
        belief: PyArray3::from_owned_array(py, checked.belief),
        states: intent.states,
        policy: intent.policy,
        belief_from: intent.belief_from,
        objective: intent.objective,
        plan_millis: intent.plan_millis,
        pid: header.pid,
        robots: (header.first_robot, header.n_robots),
        n_lost,
    })
}

/// Returns the fields of `WorldResult`.
pub fn of_world(it: &WorldResult) -> WorldRow {
    (
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
    )
}

/// Returns the fields of `RobotResult`.
pub fn of_robot(it: &RobotResult) -> Robot {
    (
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
    )
}
