//! The class `Client`: a connection to a server, or worlds in this process.

use crate::answer::StepAnswer;
use crate::arguments::{Number, absolute_path, count, duration, range_of};
use crate::errors::{plain, raise, raise_of_channel};
use crate::lease::Lease;
use crate::model::shape_of;
use crate::owned::Owned;
use crate::records;
use crate::settings::CheckedSettings;
use crate::wire::Connection;
use emberwatch_messages::backend::{Backend, StepAnswer as Answered};
use emberwatch_messages::control::{Reply, Request, ServerInfo};
use emberwatch_messages::errors::{ConnectionError, unexpected};
use emberwatch_messages::instance::Instance;
use emberwatch_messages::lease::{self, Claim};
use emberwatch_messages::left_belief;
use emberwatch_messages::message::{FLAG_TEAM_FRAMES, Operation, StepRequest, worlds_of};
use emberwatch_model::Shape;
use emberwatch_sim::embedded::INSTANCE;
use pyo3::prelude::*;
use pyo3::types::PyTuple;
use std::borrow::Cow;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};

/// Steps that are expected to be shorter than this keep the interpreter locked: 1 ms, in nanoseconds.
const BRIEF_NANOS: u64 = 1_000_000;

const NAME: &str = concat!("emberwatch-python ", env!("CARGO_PKG_VERSION"));

/// A connection to a running server, or to worlds in this process (see `embed`).
///
/// Close it after use, or use it as a context manager. Threads may share it: their requests run
/// one after another. Every call waits at most `timeout` seconds for its answer.
///
/// `instance` is the server's name, `timeout` the time in seconds to wait for its answer, and `wait`
/// the time to wait for a server that is still starting.
///
/// Attributes:
///     info: A `ServerInfo`, the server's description of itself and its worlds.
///     instance: The server's instance name; "(embedded)" for worlds in this process.
///
/// Raises:
///     NoServerError: If no server runs under this name within `wait` seconds.
///     RequestTimeoutError: If the server does not answer.
///     EmberwatchError: With code `"version_mismatch"` if the server has another protocol version,
///         or `"channel"` if the channels cannot be opened or the server has too many clients.
#[pyclass(frozen, subclass, weakref, dict, module = "emberwatch")]
pub struct Client {
    pub worlds: Owned<Box<dyn Backend + Send>>,
    pub server: ServerInfo,
    #[pyo3(get)]
    info: Py<PyAny>,
    #[pyo3(get)]
    instance: String,
    shape: Shape,
    is_embedded: bool,
    /// Duration of the last step divided by its number of robots, nanoseconds; 0 before the first step.
    nanos_of_robot: AtomicU64,
}

#[pymethods]
impl Client {
    #[new]
    #[pyo3(signature = (instance="default", *, timeout=5.0, wait=0.0))]
    fn new(py: Python<'_>, instance: &str, timeout: f64, wait: f64) -> PyResult<Self> {
        let name = checked(py, instance)?;
        let mut warned = Ok(());
        let limits = (duration(py, wait)?, duration(py, timeout)?);
        let opened = py.detach(|| {
            let mut has_warned = false;
            Connection::open_within(&name, NAME, limits, |error| {
                if !has_warned {
                    let text = format!("{}; waiting up to {wait} s for a server", plain(error));
                    warned = Python::attach(|py| warn_in_log(py, &text));
                }
                has_warned = true;
                warned.is_ok()
            })
        });
        warned?;
        let opened = opened.map_err(|error| raise(py, error, "'hello'", timeout))?;
        Self::of(py, instance, Box::new(opened))
    }

    /// Creates worlds in this process from checked settings; see `embed`.
    ///
    /// `seed` is the first world's; None: the seed in the settings.
    #[staticmethod]
    #[pyo3(signature = (settings, seed=None))]
    fn embedded(py: Python<'_>, settings: &CheckedSettings, seed: Option<u64>) -> PyResult<Self> {
        Self::of(py, INSTANCE, Box::new(settings.embed(py, seed)?))
    }

    /// Acquires the right to fly consecutive robots. Waits for the end of their worlds' burn-in.
    ///
    /// Robot r of world w has number w R + r, with R = `info.n_robots`. To resume an episode that
    /// another agent left, continue from `lease.observe()`, which returns k, the robot's cell and
    /// the last frame. To begin a new episode, call `lease.reset()`.
    ///
    /// Args:
    ///     first_robot: The number of the first robot.
    ///     n_robots: Number of robots.
    ///     takeover: Whether to take robots away from the clients that hold them.
    ///     ttl: Seconds without use after which the lease expires; None: the server's default.
    ///
    /// Raises:
    ///     EmberwatchError: With code `"busy"` if another client holds one of the robots, or
    ///         `"no_such_robot"` if one does not exist.
    #[pyo3(signature = (first_robot=Number(0), n_robots=Number(1), *, takeover=false, ttl=None, timeout=600.0))]
    #[pyo3(
        text_signature = "($self, first_robot=0, n_robots=1, *, takeover=False, ttl=None, timeout=600.0)"
    )]
    fn acquire(
        slf: Bound<'_, Self>,
        first_robot: Number,
        n_robots: Number,
        takeover: bool,
        ttl: Option<f64>,
        timeout: f64,
    ) -> PyResult<Lease> {
        let py = slf.py();
        let claim = Claim {
            robots: robots(first_robot, n_robots),
            takeover,
            time_to_live: ttl.map(|ttl| duration(py, ttl)).transpose()?,
        };
        let limit = duration(py, timeout)?;
        let acquire = |backend: &mut dyn Backend| lease::Lease::acquire(backend, &claim, limit);
        let (lease, given) = slf.get().ask(py, "'acquire'", timeout, acquire)?;
        Lease::of(&slf, lease, &given, claim.robots)
    }

    /// Returns results and frames of the last step again. Needs no lease and changes nothing.
    ///
    /// Args:
    ///     first_robot: The number of the first robot.
    ///     n_robots: Number of robots.
    ///     team: Whether to return one frame for each world's team instead of one for each robot.
    #[pyo3(signature = (first_robot=Number(0), n_robots=Number(1), *, team=false, timeout=5.0))]
    #[pyo3(text_signature = "($self, first_robot=0, n_robots=1, *, team=False, timeout=5.0)")]
    fn observe(
        &self,
        py: Python<'_>,
        first_robot: Number,
        n_robots: Number,
        team: bool,
        timeout: f64,
    ) -> PyResult<StepAnswer> {
        let robots = robots(first_robot, n_robots);
        self.look(py, (Operation::Observe, &robots, team), &[], timeout)
    }

    /// Returns the results and frames of an earlier step k of the episode.
    ///
    /// Args:
    ///     step: The step k. The other arguments are those of `observe`.
    ///
    /// Raises:
    ///     EmberwatchError: With code `"not_kept"` if the server has discarded the step; `detail`
    ///         is the nearest step that it keeps.
    #[pyo3(signature = (step, first_robot=Number(0), n_robots=Number(1), *, team=false, timeout=5.0))]
    #[pyo3(text_signature = "($self, step, first_robot=0, n_robots=1, *, team=False, timeout=5.0)")]
    fn recall(
        &self,
        py: Python<'_>,
        step: &Bound<'_, PyAny>,
        first_robot: Number,
        n_robots: Number,
        team: bool,
        timeout: f64,
    ) -> PyResult<StepAnswer> {
        let step = count(step, "step")?;
        let robots = robots(first_robot, n_robots);
        let worlds = worlds_of(robots.start, robots.len() as u32, self.server.n_robots);
        // Of more worlds than there are, the server refuses the first robot that does not exist.
        let n_worlds = worlds.len().min(self.server.n_worlds as usize + 1);
        let body = vec![step; n_worlds];
        let place = (Operation::Recall, &robots, team);
        self.look(py, place, bytemuck::cast_slice(&body), timeout)
    }

    /// Writes worlds to a file on the server's host, for `Lease.restore`, and returns their states.
    ///
    /// Args:
    ///     path: The file. A relative path starts at this process's working directory.
    ///     first_world: The first world to write.
    ///     n_worlds: Number of worlds; None: all worlds from `first_world` on.
    #[pyo3(text_signature = "($self, path, first_world=0, n_worlds=None, *, timeout=600.0)")]
    #[pyo3(signature = (path, first_world=Number(0), n_worlds=None, *, timeout=600.0))]
    fn snapshot<'py>(
        &self,
        py: Python<'py>,
        path: &Bound<'py, PyAny>,
        first_world: Number,
        n_worlds: Option<Number>,
        timeout: f64,
    ) -> PyResult<Bound<'py, PyTuple>> {
        let others = self.server.n_worlds.saturating_sub(first_world.0);
        let request = Request::Snapshot {
            first_world: first_world.0,
            n_worlds: n_worlds.map_or(others, |it| it.0),
            path: absolute_path(path)?,
        };
        match self.request(py, "'snapshot'", &request, timeout)? {
            Reply::Snapshot { worlds, .. } => records::worlds(py, &worlds),
            other => Err(raise(py, unexpected("snapshot", &other), "", timeout)),
        }
    }

    /// Returns the belief about the current step that a robot's last agent left, or None.
    ///
    /// Another agent can resume with this belief; see `Lease.leave_belief`.
    #[pyo3(signature = (robot=Number(0), *, timeout=5.0))]
    #[pyo3(text_signature = "($self, robot=0, *, timeout=5.0)")]
    fn belief<'py>(
        &self,
        py: Python<'py>,
        robot: Number,
        timeout: f64,
    ) -> PyResult<Option<Bound<'py, PyAny>>> {
        let limit = duration(py, timeout)?;
        let load = |backend: &mut dyn Backend| left_belief::load(backend, robot.0, None, limit);
        let left = self.ask(py, "'belief'", timeout, load)?;
        left.map(|left| records::left_belief(py, &left)).transpose()
    }

    /// Returns the server's load, and the state of each world, as a `ServerStatus`.
    #[pyo3(signature = (*, timeout=5.0))]
    fn status<'py>(&self, py: Python<'py>, timeout: f64) -> PyResult<Bound<'py, PyAny>> {
        match self.request(py, "'status'", &Request::Status {}, timeout)? {
            Reply::Status(status) => records::status(py, &status),
            other => Err(raise(py, unexpected("status", &other), "", timeout)),
        }
    }

    /// Stops the server for all its clients.
    #[pyo3(signature = (*, timeout=5.0))]
    fn shutdown(&self, py: Python<'_>, timeout: f64) -> PyResult<()> {
        let stopped = self.request(py, "'shutdown'", &Request::Shutdown {}, timeout);
        stopped.map(drop)
    }

    /// Returns the hidden states of worlds in this process, one `Truth` for each world.
    ///
    /// Raises:
    ///     InvalidArgumentError: Unless these worlds are in this process, with `publish_truth`.
    fn truths<'py>(
        &self,
        py: Python<'py>,
        worlds: &Bound<'py, PyAny>,
    ) -> PyResult<Vec<Bound<'py, PyAny>>> {
        let worlds = range_of("worlds", worlds, &(0..u32::MAX))?;
        let truths = self.ask(py, "truths", 0.0, |backend| backend.truths(worlds.clone()))?;
        let truths = worlds.zip(truths);
        truths
            .map(|(world, (result, states))| records::truth_of(py, world, &result, states))
            .collect()
    }

    /// Returns the state of all worlds in this process, as bytes of a snapshot.
    ///
    /// Raises:
    ///     InvalidArgumentError: If the worlds are on a server; see `snapshot`.
    fn clone_state(&self, py: Python<'_>) -> PyResult<Cow<'static, [u8]>> {
        let clone = |backend: &mut dyn Backend| backend.clone_state();
        self.ask(py, "clone_state", 0.0, clone).map(Cow::from)
    }

    /// Replaces all worlds in this process with the worlds that `clone_state` returned.
    ///
    /// Then call `Lease.observe`: the next paths start from the steps that it returns.
    ///
    /// Raises:
    ///     InvalidArgumentError: If the bytes are damaged or of other worlds, or the worlds are on
    ///         a server. No world has changed then.
    fn restore_state(&self, py: Python<'_>, worlds: Cow<'_, [u8]>) -> PyResult<()> {
        let restore = |backend: &mut dyn Backend| backend.restore_state(&worlds);
        self.ask(py, "restore_state", 0.0, restore)
    }

    /// Closes the connection, which ends its leases. May be called again.
    fn close(&self, py: Python<'_>) -> PyResult<()> {
        self.worlds.close(py)
    }

    fn __enter__(slf: PyRef<'_, Self>) -> PyRef<'_, Self> {
        slf
    }

    #[pyo3(signature = (*_error))]
    fn __exit__(&self, py: Python<'_>, _error: &Bound<'_, PyTuple>) -> PyResult<()> {
        self.close(py)
    }

    fn __repr__(&self) -> String {
        format!("<Client of instance {:?}>", self.instance)
    }
}

impl Client {
    fn of(py: Python<'_>, instance: &str, worlds: Box<dyn Backend + Send>) -> PyResult<Self> {
        let server = worlds.info().clone();
        Ok(Self {
            shape: shape_of(py, server.height, server.width)?,
            info: records::server_info(py, &server)?.unbind(),
            instance: instance.into(),
            is_embedded: instance == INSTANCE,
            nanos_of_robot: AtomicU64::new(0),
            server,
            worlds: Owned::new(instance, worlds),
        })
    }

    /// Sends requests with the interpreter unlocked. `what` names them in errors; `seconds` was the timeout.
    pub fn ask<T: Send>(
        &self,
        py: Python<'_>,
        what: &str,
        seconds: f64,
        act: impl FnOnce(&mut dyn Backend) -> Result<T, ConnectionError> + Send,
    ) -> PyResult<T> {
        let answer = self.worlds.with(py, |backend| act(&mut **backend))?;
        answer.map_err(|error| raise(py, error, what, seconds))
    }

    fn request(
        &self,
        py: Python<'_>,
        what: &str,
        request: &Request,
        seconds: f64,
    ) -> PyResult<Reply> {
        let limit = duration(py, seconds)?;
        self.ask(py, what, seconds, |backend| backend.control(request, limit))
    }

    fn look(
        &self,
        py: Python<'_>,
        (operation, robots, team): (Operation, &Range<u32>, bool),
        body: &[u8],
        seconds: f64,
    ) -> PyResult<StepAnswer> {
        let request = StepRequest {
            operation: operation as u32,
            first_robot: robots.start,
            n_robots: robots.len() as u32,
            flags: if team { FLAG_TEAM_FRAMES } else { 0 },
            ..StepRequest::default()
        };
        let limit = duration(py, seconds)?;
        let answer = self
            .worlds
            .with(py, |backend| backend.step(request, body, limit))?;
        self.answered(py, answer, seconds)
    }

    pub fn answered(
        &self,
        py: Python<'_>,
        answer: Result<Answered, ConnectionError>,
        seconds: f64,
    ) -> PyResult<StepAnswer> {
        let (reply, payload) = answer.map_err(|error| raise(py, error, "a step", seconds))?;
        let team = self.server.n_robots;
        Ok(StepAnswer::of(py, team, self.shape, &reply, payload))
    }

    /// Returns whether a step of this number of robots is expected to be so short that it can keep the interpreter
    /// locked. Otherwise, getting the interpreter back from a busy thread can take 5 ms. Returns `false` on
    /// a connection to a server, and before the first step, when no duration is known.
    pub fn is_brief(&self, n_robots: u32) -> bool {
        let nanos = self.nanos_of_robot.load(Ordering::Relaxed);
        self.is_embedded && nanos > 0 && nanos.saturating_mul(n_robots.into()) < BRIEF_NANOS
    }

    pub fn took(&self, nanos: u64, n_robots: u32) {
        let nanos = nanos / u64::from(n_robots.max(1));
        self.nanos_of_robot.store(nanos.max(1), Ordering::Relaxed);
    }
}

fn robots(first: Number, n_robots: Number) -> Range<u32> {
    first.0..first.0.saturating_add(n_robots.0)
}

pub fn checked(py: Python<'_>, instance: &str) -> PyResult<Instance> {
    Instance::new(instance).map_err(|error| raise_of_channel(py, error))
}

pub fn warn_in_log(py: Python<'_>, text: &str) -> PyResult<()> {
    let logger = py
        .import("logging")?
        .call_method1("getLogger", ("emberwatch",))?;
    logger.call_method1("warning", (text,)).map(drop)
}
