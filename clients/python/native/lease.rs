//! A lease: the right to fly consecutive robots. Remembers, for each world, the step k that the next paths start from.

use crate::answer::Answer;
use crate::backend::Worlds;
use crate::connection::{Connection, duration};
use crate::errors::interruption;
use crate::moves;
use crate::refusal::invalid;
use emberwatch_messages::backend::StepAnswer;
use emberwatch_messages::errors::ConnectionError;
use emberwatch_messages::lease::{self, Call};
use emberwatch_messages::message::{Operation, worlds_of};
use pyo3::prelude::*;

/// A lease on robots of a server.
#[pyclass(frozen, module = "emberwatch._native")]
pub struct Lease {
    server: Py<Connection>,
    lease: lease::Lease,
}

#[pymethods]
impl Lease {
    #[new]
    fn new(server: Py<Connection>, number: u64, first_robot: u32, n_robots: u32) -> Self {
        let robots = first_robot..first_robot.saturating_add(n_robots);
        let lease = lease::Lease::new(&server.get().info, number, &robots);
        Self { server, lease }
    }

    /// Flies a path with each robot. Returns `None` if the paths must be converted first (see `moves::paths`).
    fn step(
        &self,
        py: Python<'_>,
        paths: &Bound<'_, PyAny>,
        first_robot: u32,
        n_robots: u32,
        flags: u32,
        seconds: f64,
    ) -> PyResult<Option<Answer>> {
        let Some(moves) = self.moves(paths, first_robot, n_robots)? else {
            return Ok(None);
        };
        let place = (first_robot, n_robots, flags);
        let answer = self.ask(py, &mut self.call(Operation::Step, place, &moves, seconds));
        self.server.get().answered(py, answer, seconds).map(Some)
    }

    /// Flies a path with each robot. After each timeout, checks whether the worlds have stepped, and sends the paths
    /// again if not. Returns the latest results, and the number of steps missed before them; `None` as in `step`. With
    /// `accepts_late`, a world that steps without these paths causes no error.
    fn send_paths(
        &self,
        py: Python<'_>,
        paths: &Bound<'_, PyAny>,
        first_robot: u32,
        n_robots: u32,
        accepts_late: bool,
        seconds: f64,
    ) -> PyResult<Option<(Answer, u64)>> {
        let Some(moves) = self.moves(paths, first_robot, n_robots)? else {
            return Ok(None);
        };
        let paths = self.call(Operation::Step, (first_robot, n_robots, 0), &moves, seconds);
        let send = |call: &mut Call<'_>| self.ask(py, call);
        let waits = || {
            let warned = self.warn_of_wait(py, first_robot);
            warned.map(|()| false).map_err(interruption)
        };
        let flown = self.lease.send_paths(paths, accepts_late, send, waits);
        let flown = flown.map(|flown| flown.expect("invariant: it is never given up"));
        let n_skipped = flown.as_ref().map_or(0, |flown| flown.1);
        let answer = flown.map(|flown| flown.0);
        let answer = self.server.get().answered(py, answer, seconds)?;
        Ok(Some((answer, n_skipped)))
    }

    /// Requests the latest results and frames again. The next paths start from the returned steps.
    fn observe(
        &self,
        py: Python<'_>,
        first_robot: u32,
        n_robots: u32,
        flags: u32,
        seconds: f64,
    ) -> PyResult<Answer> {
        let place = (first_robot, n_robots, flags);
        let answer = self.ask(py, &mut self.call(Operation::Observe, place, &[], seconds));
        self.server.get().answered(py, answer, seconds)
    }

    /// Records that a world of the lease is at this step.
    fn note(&self, world: u32, step: u64) {
        self.lease.note(world, step);
    }

    /// The step of each world.
    #[getter]
    fn steps(&self) -> Vec<u64> {
        self.lease.steps()
    }
}

impl Lease {
    fn call<'a>(
        &self,
        operation: Operation,
        (first_robot, n_robots, flags): (u32, u32, u32),
        moves: &'a [u8],
        seconds: f64,
    ) -> Call<'a> {
        let robots = first_robot..first_robot.saturating_add(n_robots);
        let request = self.lease.request(operation, &robots, flags);
        Call::new(request, moves, duration(seconds))
    }

    /// Checks that the lease includes these robots. Returns their paths as bytes, or `None` if `moves::paths` does.
    fn moves(
        &self,
        paths: &Bound<'_, PyAny>,
        first_robot: u32,
        n_robots: u32,
    ) -> PyResult<Option<Vec<u8>>> {
        let (info, own) = (&self.server.get().info, self.lease.worlds());
        let worlds = worlds_of(first_robot, n_robots, info.n_robots);
        if worlds.start < own.start || worlds.end > own.end {
            let expected = format!("robots of worlds {own:?}");
            let got = format!("{n_robots} robots from robot {first_robot}");
            return Err(invalid(paths.py(), "step", expected, got));
        }
        Ok(moves::paths(paths, n_robots as usize, info.n_moves))
    }

    /// Sends a request while no other thread uses the connection, so that two threads never send paths for the same
    /// step.
    fn ask(&self, py: Python<'_>, call: &mut Call<'_>) -> Result<StepAnswer, ConnectionError> {
        let (server, request) = (self.server.get(), *call.request());
        let send = |worlds: &mut Worlds| self.lease.send(worlds.backend(), call);
        let answer = if server.is_brief(request.n_robots) {
            if worlds_of(request.first_robot, request.n_robots, server.info.n_robots).len() > 1 {
                server.worlds.check(py).map_err(interruption)?;
            }
            server.worlds.with_briefly(py, send)
        } else {
            server.worlds.with(py, send)
        };
        let answer = answer.map_err(interruption)??;
        if request.operation == Operation::Step as u32 {
            server.took(answer.0.simulation_nanos, request.n_robots);
        }
        Ok(answer)
    }

    /// Logs that a step waits for the paths of other robots.
    fn warn_of_wait(&self, py: Python<'_>, first_robot: u32) -> PyResult<()> {
        let world = worlds_of(first_robot, 1, self.server.get().info.n_robots).start;
        let text = format!(
            "world {world} waits for the paths of its other leased robots; environments of one world need a thread or \
             process each"
        );
        let logger = py
            .import("logging")?
            .call_method1("getLogger", ("emberwatch",))?;
        logger.call_method1("warning", (text,)).map(|_| ())
    }
}
