//! The class `Lease`: the right to fly consecutive robots.

use crate::answer::StepAnswer;
use crate::arguments::{Number, absolute_path, duration, paths, range_of, seeds};
use crate::client::{Client, warn_in_log};
use crate::errors::interruption;
use crate::records;
use emberwatch_messages::backend::{Backend, StepAnswer as Answered};
use emberwatch_messages::control::{LeaseInfo, WorldInfo};
use emberwatch_messages::errors::ConnectionError;
use emberwatch_messages::lease::{self, Call};
use emberwatch_messages::left_belief;
use emberwatch_messages::message::{
    FLAG_FULL_COVERAGE, FLAG_TEAM_FRAMES, Operation, WorldResult, worlds_of,
};
use pyo3::prelude::*;
use pyo3::types::{PyRange, PyTuple};
use std::borrow::Cow;
use std::ops::Range;
use std::sync::atomic::{AtomicBool, Ordering};

/// The right to fly consecutive robots. It ends with `release`, or on leaving its `with` block.
///
/// For each world, the lease remembers the step k that it last stepped to, reset to or observed.
/// The next path is for step k + 1, and the server flies it in no other step.
///
/// Attributes:
///     client: The `Client` that acquired it.
///     ttl: Seconds without use after which the lease expires.
///     robots: The numbers of its robots, a range.
///     worlds: The worlds of these robots, a range.
///     start: The state of these worlds when the lease was granted, a tuple of `WorldInfo`.
#[pyclass(frozen, subclass, weakref, dict, module = "emberwatch")]
pub struct Lease {
    #[pyo3(get)]
    client: Py<Client>,
    lease: lease::Lease,
    robots: Range<u32>,
    #[pyo3(get)]
    ttl: f64,
    #[pyo3(get)]
    start: Py<PyTuple>,
    is_over: AtomicBool,
}

#[pymethods]
impl Lease {
    #[getter]
    fn robots<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyRange>> {
        python_range(py, &self.robots)
    }

    #[getter]
    fn worlds<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyRange>> {
        python_range(py, &self.lease.worlds())
    }

    /// Flies one path with each robot, and moves the worlds from k to k + 1.
    ///
    /// If other clients hold robots of the same world, the step waits for their paths, too.
    ///
    /// Args:
    ///     paths: Moves: 0 up, 1 down, 2 left, 3 right. Integers of shape (n_robots, T), or (T,)
    ///         for one robot.
    ///     robots: The numbers of consecutive robots to fly, which must be all the lease's robots
    ///         in one or more worlds. None: all robots of the lease.
    ///     full: Whether to observe every cell. Requires a server with coverage "client" or "full".
    ///     team: Whether to return one frame for each world's team instead of one for each robot.
    ///
    /// Raises:
    ///     InvalidArgumentError: If the paths do not have this shape, type and range.
    ///     LeaseLostError: If the lease expired or a robot was taken over.
    ///     RequestTimeoutError: If no answer arrives; `observe` shows whether the step was made.
    ///     ServerGoneError: If the server ended.
    ///     EmberwatchError: With code `"late"` if the world moved on without this path; `observe`
    ///         shows to which step. With code `"episode_over"` if the episode has ended: reset that
    ///         world.
    #[pyo3(signature = (paths, *, robots=None, full=false, team=false, timeout=5.0))]
    fn step(
        &self,
        py: Python<'_>,
        paths: &Bound<'_, PyAny>,
        robots: Option<&Bound<'_, PyAny>>,
        full: bool,
        team: bool,
        timeout: f64,
    ) -> PyResult<StepAnswer> {
        let robots = self.part(robots)?;
        let moves = self.moves(paths, &robots)?;
        let flags = if full { FLAG_FULL_COVERAGE } else { 0 } | team_flag(team);
        let request = self.lease.request(Operation::Step, &robots, flags);
        let mut call = Call::new(request, &moves, duration(py, timeout)?);
        let answer = self.send(py, &mut call);
        self.client.get().answered(py, answer, timeout)
    }

    /// Flies one path with each robot as `step` does, but waits as long as teammates take.
    ///
    /// After each timeout it observes whether the worlds have moved, and sends the paths again if
    /// not. It keeps waiting as long as the server answers. A world that another thread's paths
    /// moved counts as having moved on without these paths.
    ///
    /// Args:
    ///     paths, robots: As in `step`.
    ///     accepts_late: Whether to return the current results of a world that moved on without
    ///         these paths, instead of raising the error with code `"late"`.
    ///     timeout: Seconds to wait before each check whether the worlds have moved. The server's
    ///         own deadline for teammates is added.
    ///
    /// Returns:
    ///     The results and frames, and the number of earlier world steps that went unobserved.
    ///
    /// Raises:
    ///     RequestTimeoutError: If the server does not answer such a check either.
    ///     EmberwatchError: As in `step`.
    #[pyo3(signature = (paths, *, robots=None, accepts_late=false, timeout=5.0))]
    fn fly(
        &self,
        py: Python<'_>,
        paths: &Bound<'_, PyAny>,
        robots: Option<&Bound<'_, PyAny>>,
        accepts_late: bool,
        timeout: f64,
    ) -> PyResult<(StepAnswer, u64)> {
        let robots = self.part(robots)?;
        let moves = self.moves(paths, &robots)?;
        let request = self.lease.request(Operation::Step, &robots, 0);
        let call = Call::new(request, &moves, duration(py, timeout)?);
        let send = |call: &mut Call<'_>| self.send(py, call);
        let waits = || {
            let warned = self.warn_of_wait(py, robots.start);
            warned.map(|()| false).map_err(interruption)
        };
        let flown = self.lease.send_paths(call, accepts_late, send, waits);
        let flown = flown.map(|flown| flown.expect("invariant: it is never given up"));
        let n_skipped = flown.as_ref().map_or(0, |flown| flown.1);
        let answer = flown.map(|flown| flown.0);
        let answer = self.client.get().answered(py, answer, timeout)?;
        Ok((answer, n_skipped))
    }

    /// Returns the results and frames of the last step again.
    ///
    /// The next `step` continues from the observed step.
    ///
    /// Args:
    ///     robots: The numbers of consecutive robots; None: all robots of the lease.
    ///     team: As in `step`.
    #[pyo3(signature = (*, robots=None, team=false, timeout=5.0))]
    fn observe(
        &self,
        py: Python<'_>,
        robots: Option<&Bound<'_, PyAny>>,
        team: bool,
        timeout: f64,
    ) -> PyResult<StepAnswer> {
        let robots = self.part(robots)?;
        let flags = team_flag(team);
        let request = self.lease.request(Operation::Observe, &robots, flags);
        let answer = self.send(py, &mut Call::new(request, &[], duration(py, timeout)?));
        self.client.get().answered(py, answer, timeout)
    }

    /// Begins new episodes: burn-in, then k = 0, robots at their start cells, empty frames.
    ///
    /// No other client may hold robots of these worlds. Returns the state of each, in the given order.
    ///
    /// Args:
    ///     seeds: One seed for each world; None: the server derives each seed from the world's last
    ///         seed.
    ///     worlds: The worlds to reset; None: all worlds of the lease.
    #[pyo3(signature = (seeds=None, *, worlds=None, timeout=600.0))]
    fn reset<'py>(
        &self,
        py: Python<'py>,
        seeds: Option<&Bound<'py, PyAny>>,
        worlds: Option<&Bound<'py, PyAny>>,
        timeout: f64,
    ) -> PyResult<Bound<'py, PyTuple>> {
        let all = self.worlds(py)?.into_any();
        let n_worlds = self.client.get().server.n_worlds;
        let seeds = self::seeds(py, seeds, worlds.unwrap_or(&all), n_worlds)?;
        let limit = duration(py, timeout)?;
        self.replace(py, "'reset'", timeout, |backend| {
            self.lease.reset(backend, seeds, limit)
        })
    }

    /// Replaces worlds of the lease with worlds from a snapshot file, and returns their states.
    ///
    /// The restored worlds continue exactly as the saved ones would have.
    ///
    /// Args:
    ///     path: The file, written by `Client.snapshot` or `emberwatch-server snapshot`.
    ///     worlds: The consecutive worlds to replace; None: all worlds of the lease.
    ///     first: The number of the first world in the file to use; the next worlds follow.
    #[pyo3(signature = (path, *, worlds=None, first=Number(0), timeout=600.0))]
    #[pyo3(text_signature = "($self, path, *, worlds=None, first=0, timeout=600.0)")]
    fn restore<'py>(
        &self,
        py: Python<'py>,
        path: &Bound<'py, PyAny>,
        worlds: Option<&Bound<'py, PyAny>>,
        first: Number,
        timeout: f64,
    ) -> PyResult<Bound<'py, PyTuple>> {
        let all = self.lease.worlds();
        let worlds = match worlds {
            Some(worlds) => range_of("worlds", worlds, &all)?,
            None => all,
        };
        let file = (absolute_path(path)?, first.0);
        let limit = duration(py, timeout)?;
        self.replace(py, "'restore'", timeout, |backend| {
            self.lease.restore(backend, &worlds, file, limit)
        })
    }

    /// Replaces the lease's world `target` with a copy of the world `source`; returns its state.
    ///
    /// With the same actions, both worlds have the same future.
    #[pyo3(signature = (source, target, *, timeout=5.0))]
    fn fork<'py>(
        &self,
        py: Python<'py>,
        source: Number,
        target: Number,
        timeout: f64,
    ) -> PyResult<Bound<'py, PyTuple>> {
        let limit = duration(py, timeout)?;
        self.replace(py, "'fork'", timeout, |backend| {
            self.lease.fork(backend, (source.0, target.0), limit)
        })
    }

    /// Stores a belief about the current step for a robot's next client; see `Client.belief`.
    ///
    /// Args:
    ///     result: The robot's last result. The server refuses a result of an earlier step.
    ///     kind: The format of the bytes, for other agents. At most 256 bytes.
    ///     data: At most 32,768 bytes plus 76 per cell; more if the model has over 18 states.
    ///     robot: The robot's number; None: the first robot of the lease.
    #[pyo3(signature = (result, kind, data, *, robot=None, timeout=5.0))]
    fn leave_belief(
        &self,
        py: Python<'_>,
        result: &Bound<'_, PyAny>,
        kind: &str,
        data: Cow<'_, [u8]>,
        robot: Option<Number>,
        timeout: f64,
    ) -> PyResult<()> {
        let world = result.getattr("world")?;
        let at = WorldResult {
            episode: world.getattr("episode")?.extract()?,
            step: world.getattr("step")?.extract()?,
            ..WorldResult::default()
        };
        let robot = robot.map_or(self.robots.start, |it| it.0);
        let (place, limit) = ((self.lease.number(), robot), duration(py, timeout)?);
        let leave =
            |backend: &mut dyn Backend| left_belief::leave(backend, place, &at, kind, &data, limit);
        self.client.get().ask(py, "'leave_belief'", timeout, leave)
    }

    /// Restarts the lease's expiry time without acting.
    #[pyo3(signature = (*, timeout=600.0))]
    fn renew(&self, py: Python<'_>, timeout: f64) -> PyResult<()> {
        let limit = duration(py, timeout)?;
        let renew = |backend: &mut dyn Backend| self.lease.renew(backend, limit);
        self.client.get().ask(py, "'renew'", timeout, renew)
    }

    /// Ends the lease, so that other clients may fly its robots. May be called again.
    #[pyo3(signature = (*, timeout=5.0))]
    fn release(&self, py: Python<'_>, timeout: f64) -> PyResult<()> {
        if self.is_over.load(Ordering::Relaxed) {
            return Ok(());
        }
        let limit = duration(py, timeout)?;
        let release = |backend: &mut dyn Backend| self.lease.release(backend, limit);
        self.client.get().ask(py, "'release'", timeout, release)?;
        self.is_over.store(true, Ordering::Relaxed);
        Ok(())
    }

    fn __enter__(slf: PyRef<'_, Self>) -> PyRef<'_, Self> {
        slf
    }

    /// Releases the robots. If an error ends the block, that error is kept, because it says more.
    #[pyo3(signature = (kind, *_error))]
    fn __exit__(
        &self,
        py: Python<'_>,
        kind: &Bound<'_, PyAny>,
        _error: &Bound<'_, PyTuple>,
    ) -> PyResult<()> {
        match self.release(py, 5.0) {
            Err(_) if !kind.is_none() => Ok(()),
            released => released,
        }
    }

    fn __repr__(&self) -> String {
        let Range { start, end } = self.robots;
        format!("<Lease of robots {start} to {}>", end - 1)
    }
}

impl Lease {
    pub fn of(
        client: &Bound<'_, Client>,
        lease: lease::Lease,
        given: &LeaseInfo,
        robots: Range<u32>,
    ) -> PyResult<Self> {
        Ok(Self {
            client: client.clone().unbind(),
            lease,
            robots,
            ttl: given.ttl_millis as f64 / 1000.0,
            start: records::worlds(client.py(), &given.worlds)?.unbind(),
            is_over: AtomicBool::new(false),
        })
    }

    fn part(&self, robots: Option<&Bound<'_, PyAny>>) -> PyResult<Range<u32>> {
        match robots {
            Some(robots) => range_of("robots", robots, &self.robots),
            None => Ok(self.robots.clone()),
        }
    }

    fn moves(&self, given: &Bound<'_, PyAny>, robots: &Range<u32>) -> PyResult<Vec<u8>> {
        paths(given, robots.len(), self.client.get().server.n_moves)
    }

    fn replace<'py>(
        &self,
        py: Python<'py>,
        what: &str,
        seconds: f64,
        ask: impl FnOnce(&mut dyn Backend) -> Result<Vec<WorldInfo>, ConnectionError> + Send,
    ) -> PyResult<Bound<'py, PyTuple>> {
        let worlds = self.client.get().ask(py, what, seconds, ask)?;
        records::worlds(py, &worlds)
    }

    /// Sends a request while no other thread uses the connection, so that two threads never send paths for the same
    /// step.
    fn send(&self, py: Python<'_>, call: &mut Call<'_>) -> Result<Answered, ConnectionError> {
        let (client, request) = (self.client.get(), *call.request());
        let send = |backend: &mut Box<dyn Backend + Send>| self.lease.send(&mut **backend, call);
        let answer = if client.is_brief(request.n_robots) {
            if worlds_of(
                request.first_robot,
                request.n_robots,
                client.server.n_robots,
            )
            .len()
                > 1
            {
                client.worlds.check(py).map_err(interruption)?;
            }
            client.worlds.with_briefly(py, send)
        } else {
            client.worlds.with(py, send)
        };
        let answer = answer.map_err(interruption)??;
        if request.operation == Operation::Step as u32 {
            client.took(answer.0.simulation_nanos, request.n_robots);
        }
        Ok(answer)
    }

    fn warn_of_wait(&self, py: Python<'_>, first_robot: u32) -> PyResult<()> {
        let world = worlds_of(first_robot, 1, self.client.get().server.n_robots).start;
        let text = format!(
            "world {world} waits for the paths of its other leased robots; environments of one world need a thread or \
             process each"
        );
        warn_in_log(py, &text)
    }
}

fn team_flag(team: bool) -> u32 {
    if team { FLAG_TEAM_FRAMES } else { 0 }
}

fn python_range<'py>(py: Python<'py>, range: &Range<u32>) -> PyResult<Bound<'py, PyRange>> {
    PyRange::new(py, range.start as isize, range.end as isize)
}
