//! A lease: the right to fly consecutive robots, and the step k for which each world's next path is.

use crate::answer::Answer;
use crate::backend::Backend;
use crate::connection::{Server, duration};
use crate::moves;
use crate::refusal::invalid;
use emberwatch_messages::errors::ConnectionError;
use emberwatch_messages::message::worlds_of;
use emberwatch_messages::message::{Operation, Status, StepReply, StepRequest, WorldResult};
use emberwatch_messages::payload::{WORLD_BYTES, write_step_body};
use emberwatch_messages::resend::{Flown, until_moved};
use pyo3::prelude::*;
use std::ops::Range;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// The steps of a lease's worlds.
#[pyclass(frozen, module = "emberwatch._native")]
pub struct Lease {
    server: Py<Server>,
    number: u64,
    worlds: Range<u32>,
    steps: Mutex<Vec<u64>>,
}

#[pymethods]
impl Lease {
    #[new]
    fn new(server: Py<Server>, number: u64, first_robot: u32, n_robots: u32) -> Self {
        let worlds = worlds_of(first_robot, n_robots, server.get().team);
        Self {
            server,
            number,
            steps: Mutex::new(vec![0; worlds.len()]),
            worlds,
        }
    }

    /// Flies a path with each robot; `None` if the paths must be converted first, see `moves::paths`.
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
        let request = self.step_request(first_robot, n_robots, flags);
        let answer = self.ask(py, request, &moves, &mut Vec::new(), duration(seconds))?;
        self.server.get().answered(py, answer, seconds).map(Some)
    }

    /// Flies a path with each robot, and sends it again until the worlds have moved. Returns how the worlds stand, and
    /// how many of their steps passed unseen before that; `None` as of `step`. `accepts_late`: where a world moved on
    /// without these paths, that is no error.
    fn fly(
        &self,
        py: Python<'_>,
        paths: &Bound<'_, PyAny>,
        first_robot: u32,
        n_robots: u32,
        accepts_late: bool,
        seconds: f64,
    ) -> PyResult<Option<(Answer, u64)>> {
        let server = self.server.get();
        let Some(moves) = self.moves(paths, first_robot, n_robots)? else {
            return Ok(None);
        };
        let request = self.step_request(first_robot, n_robots, 0);
        let first_world = worlds_of(first_robot, 1, server.team).start;
        // Sooner would take back the path with which the deadline began.
        let timeout = duration(seconds).saturating_add(server.deadline);
        // Each world's step for which the paths are meant, known once they are sent.
        let mut steps = Vec::new();
        let send = |steps: &mut Vec<u64>| match self.ask(py, request, &moves, steps, timeout)? {
            Err(ConnectionError::Timeout { .. }) => Ok(None),
            Err(ConnectionError::Refused { status, .. })
                if accepts_late && status == Status::Late =>
            {
                Ok(None)
            }
            answer => server.answered(py, answer, seconds).map(Some),
        };
        let look = |steps: &mut Vec<u64>| {
            let seen = self.observe(py, first_robot, n_robots, 0, seconds)?;
            if steps.first().is_some_and(|&before| seen.step() > before) {
                return Ok(Some(seen));
            }
            warn_of_wait(py, first_world)?;
            Ok(None)
        };
        match until_moved(&mut steps, send, look, || false)? {
            Flown::Answered(answer) => Ok(Some((answer, 0))),
            Flown::Observed(seen) => {
                let n_moved = seen.step() - steps[0];
                Ok(Some((seen, n_moved - 1)))
            }
            Flown::GivenUp => unreachable!("invariant: it is never given up"),
        }
    }

    /// The last results and frames again; steps go on from there.
    fn observe(
        &self,
        py: Python<'_>,
        first_robot: u32,
        n_robots: u32,
        flags: u32,
        seconds: f64,
    ) -> PyResult<Answer> {
        let request = self.request(Operation::Observe, first_robot, n_robots, flags);
        let answer = self.ask(py, request, &[], &mut Vec::new(), duration(seconds))?;
        self.server.get().answered(py, answer, seconds)
    }

    /// From here on a world of the lease is at this step.
    fn note(&self, world: u32, step: u64) {
        let (index, mut noted) = (world.checked_sub(self.worlds.start), self.noted());
        if let Some(noted) = index.and_then(|index| noted.get_mut(index as usize)) {
            *noted = step;
        }
    }

    /// The step of each world.
    #[getter]
    fn steps(&self) -> Vec<u64> {
        self.noted().clone()
    }
}

impl Lease {
    fn request(
        &self,
        operation: Operation,
        first_robot: u32,
        n_robots: u32,
        flags: u32,
    ) -> StepRequest {
        StepRequest {
            operation: operation as u32,
            lease: self.number,
            first_robot,
            n_robots,
            flags,
            ..StepRequest::default()
        }
    }

    fn step_request(&self, first_robot: u32, n_robots: u32, flags: u32) -> StepRequest {
        let n_moves = self.server.get().n_moves as u32;
        let request = self.request(Operation::Step, first_robot, n_robots, flags);
        StepRequest { n_moves, ..request }
    }

    /// Checks paths of robots of the lease.
    fn moves(
        &self,
        paths: &Bound<'_, PyAny>,
        first_robot: u32,
        n_robots: u32,
    ) -> PyResult<Option<Vec<u8>>> {
        let server = self.server.get();
        let worlds = worlds_of(first_robot, n_robots, server.team);
        if worlds.start < self.worlds.start || worlds.end > self.worlds.end {
            let expected = format!("robots of worlds {:?}", self.worlds);
            let got = format!("{n_robots} from {first_robot} on");
            return Err(invalid(paths.py(), "step", expected, got));
        }
        Ok(moves::paths(paths, n_robots as usize, server.n_moves))
    }

    /// Sends a request. `steps`: the step of each world for which the paths are meant; if empty, it is filled with the
    /// steps at which the worlds were last seen.
    fn ask(
        &self,
        py: Python<'_>,
        request: StepRequest,
        moves: &[u8],
        steps: &mut Vec<u64>,
        timeout: Duration,
    ) -> PyResult<Result<(StepReply, Vec<u8>), ConnectionError>> {
        let server = self.server.get();
        let worlds = worlds_of(request.first_robot, request.n_robots, server.team);
        let n_worlds = worlds.len();
        // Within the connection's turn: each thread's path is for a step of its own.
        let exchange = |backend: &mut Backend| {
            self.exchange(backend, worlds, request, (moves, steps), timeout)
        };
        if !server.is_brief(request.n_robots) {
            return server.backend.with(py, exchange);
        }
        if n_worlds > 1 {
            server.backend.check(py)?;
        }
        server.backend.with_briefly(py, exchange)
    }

    fn exchange(
        &self,
        backend: &mut Backend,
        worlds: Range<u32>,
        request: StepRequest,
        (moves, steps): (&[u8], &mut Vec<u64>),
        timeout: Duration,
    ) -> Result<(StepReply, Vec<u8>), ConnectionError> {
        let mut body = Vec::new();
        if request.operation == Operation::Step as u32 {
            if steps.is_empty() {
                steps.extend_from_slice(&self.noted()[self.indices(&worlds)]);
            }
            write_step_body(steps, moves, &mut body);
        }
        let (reply, payload) = backend.step_payload(request, &body, timeout)?;
        if !moves.is_empty() {
            let server = self.server.get();
            server.took(reply.simulation_nanos, request.n_robots);
        }
        // Robots outside the lease may be observed, too.
        let own = worlds.start.max(self.worlds.start)..worlds.end.min(self.worlds.end);
        if !own.is_empty() {
            let skipped = (own.start - worlds.start) as usize;
            let results = payload.chunks_exact(WORLD_BYTES).skip(skipped);
            let mut noted = self.noted();
            for (noted, result) in noted[self.indices(&own)].iter_mut().zip(results) {
                let result: WorldResult = bytemuck::pod_read_unaligned(result);
                *noted = result.step;
            }
        }
        Ok((reply, payload))
    }

    /// The positions of these worlds in `steps`.
    fn indices(&self, worlds: &Range<u32>) -> Range<usize> {
        (worlds.start - self.worlds.start) as usize..(worlds.end - self.worlds.start) as usize
    }

    fn noted(&self) -> MutexGuard<'_, Vec<u64>> {
        self.steps.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Logs that a step waits for other robots.
fn warn_of_wait(py: Python<'_>, world: u32) -> PyResult<()> {
    let text = format!(
        "world {world} waits for the paths of other robots that are held; environments of one world need a thread or a \
         process each"
    );
    let logger = py
        .import("logging")?
        .call_method1("getLogger", ("emberwatch",))?;
    logger.call_method1("warning", (text,)).map(|_| ())
}
