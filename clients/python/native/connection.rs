//! Connections to a server or to embedded worlds.

use crate::answer::Answer;
use crate::backend::{CheckedSettings, Worlds};
use crate::errors::{raise, raise_of_channel};
use crate::model::shape_of;
use crate::owned::Owned;
use crate::refusal::{invalid, refused};
use crate::samples::{Truth, truth_of};
use crate::wire;
use anyhow::bail;
use emberwatch_messages::backend::StepAnswer;
use emberwatch_messages::control::ServerInfo;
use emberwatch_messages::errors::ConnectionError;
use emberwatch_messages::instance::Instance;
use emberwatch_messages::message::{StepRequest, WorldResult};
use emberwatch_model::Shape;
use emberwatch_sim::embedded::{Embedded, INSTANCE};
use emberwatch_sim::results::world_result;
use emberwatch_sim::world::Episode;
use numpy::ndarray::Array2;
use pyo3::prelude::*;
use std::borrow::Cow;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// Steps that are expected to be shorter than this keep the interpreter locked: 1 ms, in nanoseconds.
const BRIEF_NANOS: u64 = 1_000_000;

/// A connection to a server, or worlds in this process. Threads can share it; their requests run one after another.
#[pyclass(frozen, module = "emberwatch._native")]
pub struct Connection {
    pub worlds: Owned<Worlds>,
    /// The server's description of itself, from its answer to `hello`.
    pub info: ServerInfo,
    /// Height and width of the grid.
    shape: Shape,
    is_embedded: bool,
    /// Duration of the last step divided by its number of robots, nanoseconds; 0 before the first step.
    nanos_of_robot: AtomicU64,
}

#[pymethods]
impl Connection {
    #[new]
    fn new(py: Python<'_>, instance: &str, client: &str, seconds: f64) -> PyResult<Self> {
        let name = checked(py, instance)?;
        let wire = py.detach(|| wire::Connection::open(&name, client, duration(seconds)));
        let wire = wire.map_err(|error| raise(py, error, "'hello'", seconds))?;
        Self::of(py, instance, Worlds::Served(Box::new(wire)))
    }

    /// Starts worlds in this process. `seed` is the first world's; `None`: the seed in the settings.
    #[staticmethod]
    #[pyo3(name = "embedded", signature = (settings, seed=None))]
    fn new_embedded(
        py: Python<'_>,
        settings: &CheckedSettings,
        seed: Option<u64>,
    ) -> PyResult<Self> {
        let worlds = Worlds::Embedded(Box::new(settings.embed(py, seed)?));
        Self::of(py, INSTANCE, worlds)
    }

    /// The server's description of itself, as JSON.
    #[getter]
    fn info(&self) -> String {
        serde_json::to_string(&self.info).expect("invariant: replies serialise")
    }

    /// Returns the hidden states of consecutive embedded worlds, as the fields of `Truth`. The setting `publish_truth`
    /// must be on.
    fn truths<'py>(
        &self,
        py: Python<'py>,
        first_world: usize,
        n_worlds: usize,
    ) -> PyResult<Vec<Truth<'py>>> {
        let worlds = first_world..first_world.saturating_add(n_worlds);
        let read = |from: &mut Worlds| match from {
            Worlds::Embedded(own) if self.info.publish_truth => {
                let found = own.episodes(worlds.clone())?;
                Ok(found.map(|found| worlds.zip(found).map(copied).collect::<Vec<_>>()))
            }
            _ => Ok(None),
        };
        let found = self.worlds.with(py, read)?;
        let found = found.map_err(|error| raise(py, error, "truths", 0.0))?;
        let Some(found) = found else {
            let expected = "embedded worlds with publish_truth that are not in a reset";
            let got = format!("{n_worlds} worlds from world {first_world}");
            return Err(invalid(py, "truths", expected, got));
        };
        let truths = found.into_iter();
        let of = |(world, result, states)| truth_of(py, world, &result, states);
        Ok(truths.map(of).collect())
    }

    /// Returns the state of all embedded worlds, for [`Self::restore`].
    fn snapshot(&self, py: Python<'_>) -> PyResult<Cow<'static, [u8]>> {
        let bytes = self.of_embedded(py, "clone_state", Embedded::snapshot)?;
        Ok(bytes.into())
    }

    /// Replaces all embedded worlds with the worlds of a snapshot.
    fn restore(&self, py: Python<'_>, bytes: &[u8]) -> PyResult<()> {
        self.of_embedded(py, "restore_state", |worlds| worlds.restore(bytes))
    }

    /// Sends a control request as JSON text. Returns the text of the answer. `what` names the request in errors.
    fn control(&self, py: Python<'_>, text: &[u8], what: &str, seconds: f64) -> PyResult<String> {
        let ask = |to: &mut Worlds| to.backend().control_text(text, duration(seconds));
        let answer = self.worlds.with(py, ask)?;
        decoded(answer).map_err(|error| raise(py, error, what, seconds))
    }

    /// Sends a request to the `step` service with exactly these header fields and this body.
    #[expect(clippy::too_many_arguments, reason = "the fields of the header")]
    fn step(
        &self,
        py: Python<'_>,
        operation: u32,
        lease: u64,
        first_robot: u32,
        n_robots: u32,
        n_moves: u32,
        flags: u32,
        body: &[u8],
        seconds: f64,
    ) -> PyResult<Answer> {
        let request = StepRequest {
            operation,
            lease,
            first_robot,
            n_robots,
            n_moves,
            flags,
            ..StepRequest::default()
        };
        let step = |to: &mut Worlds| to.backend().step(request, body, duration(seconds));
        let answer = self.worlds.with(py, step)?;
        self.answered(py, answer, seconds)
    }

    fn close(&self, py: Python<'_>) -> PyResult<()> {
        self.worlds.close(py)
    }
}

impl Connection {
    fn of(py: Python<'_>, instance: &str, mut worlds: Worlds) -> PyResult<Self> {
        let info = worlds.backend().info().clone();
        Ok(Self {
            shape: shape_of(py, info.height, info.width)?,
            is_embedded: matches!(worlds, Worlds::Embedded(_)),
            nanos_of_robot: AtomicU64::new(0),
            info,
            worlds: Owned::new(instance, worlds),
        })
    }

    /// Uses the worlds in this process. `what` names the caller in errors.
    fn of_embedded<T: Send>(
        &self,
        py: Python<'_>,
        what: &str,
        act: impl FnOnce(&mut Embedded) -> anyhow::Result<T> + Send,
    ) -> PyResult<T> {
        let done = self.worlds.with(py, |worlds| match worlds {
            Worlds::Embedded(own) => act(own),
            Worlds::Served(_) => bail!("expected worlds in this process, got worlds of a server"),
        })?;
        done.map_err(|error| match error.downcast() {
            Ok(lost) => raise(py, lost, what, 0.0),
            Err(error) => refused(py, format!("{what}: {error:#}")),
        })
    }

    /// Converts an answer to its Python object, or an error to its exception.
    pub fn answered(
        &self,
        py: Python<'_>,
        answer: Result<StepAnswer, ConnectionError>,
        seconds: f64,
    ) -> PyResult<Answer> {
        let (reply, payload) = answer.map_err(|error| raise(py, error, "a step", seconds))?;
        let team = self.info.n_robots;
        Ok(Answer::of(py, team, self.shape, &reply, payload))
    }

    /// Returns whether a step of this number of robots is expected to be so short that it can keep the interpreter
    /// locked. Otherwise, getting the interpreter back from a busy thread can take 5 ms. Returns `false` on
    /// a connection to a server, and before the first step, when no duration is known.
    pub fn is_brief(&self, n_robots: u32) -> bool {
        let nanos = self.nanos_of_robot.load(Ordering::Relaxed);
        self.is_embedded && nanos > 0 && nanos.saturating_mul(n_robots.into()) < BRIEF_NANOS
    }

    /// Records how long a step of this number of robots took.
    pub fn took(&self, nanos: u64, n_robots: u32) {
        let nanos = nanos / u64::from(n_robots.max(1));
        self.nanos_of_robot.store(nanos.max(1), Ordering::Relaxed);
    }
}

/// Copies a world's latest result and hidden states. Does not need the interpreter lock.
fn copied((world, episode): (usize, &Episode)) -> (usize, WorldResult, Array2<u8>) {
    (
        world,
        world_result(episode.outcome()),
        episode.states().to_owned(),
    )
}

/// Checks an instance's name.
pub fn checked(py: Python<'_>, instance: &str) -> PyResult<Instance> {
    Instance::new(instance).map_err(|error| raise_of_channel(py, error))
}

/// Converts a timeout. Negative numbers and NaN become 0.
pub fn duration(seconds: f64) -> Duration {
    Duration::try_from_secs_f64(seconds.clamp(0.0, 1e9)).unwrap_or_default()
}

fn decoded(answer: Result<Vec<u8>, ConnectionError>) -> Result<String, ConnectionError> {
    String::from_utf8(answer?).map_err(|error| ConnectionError::Garbled {
        what: "a control request",
        problem: format!("expected JSON, got {error}"),
    })
}
