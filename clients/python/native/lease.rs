//! A lease: the right to fly consecutive robots, and the step k for which each world's next path is.

use crate::backend::Backend;
use crate::connection::{Answer, Server, answered, duration};
use crate::moves;
use crate::refusal::invalid;
use emberwatch_messages::errors::ConnectionError;
use emberwatch_messages::message::worlds_of;
use emberwatch_messages::message::{Operation, StepReply, StepRequest, WorldResult};
use emberwatch_messages::payload::{WORLD_BYTES, write_step_body};
use pyo3::prelude::*;
use std::ops::Range;
use std::sync::{Mutex, PoisonError};

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

    /// Flies a path with each robot.
    fn step<'py>(
        &self,
        py: Python<'py>,
        paths: &Bound<'py, PyAny>,
        first_robot: u32,
        n_robots: u32,
        flags: u32,
        seconds: f64,
    ) -> PyResult<Answer<'py>> {
        let server = self.server.get();
        let worlds = worlds_of(first_robot, n_robots, server.team);
        if worlds.start < self.worlds.start || worlds.end > self.worlds.end {
            let expected = format!("robots of worlds {:?}", self.worlds);
            let got = format!("{n_robots} from {first_robot} on");
            return Err(invalid(py, "step", expected, got));
        }
        let n_moves = server.n_moves;
        let moves = moves::paths(paths, n_robots as usize, n_moves)?;
        let request = self.request(Operation::Step, first_robot, n_robots, flags);
        let request = StepRequest {
            n_moves: n_moves as u32,
            ..request
        };
        self.ask(py, request, &moves, seconds)
    }

    /// The last results and frames again; steps go on from there.
    fn observe<'py>(
        &self,
        py: Python<'py>,
        first_robot: u32,
        n_robots: u32,
        flags: u32,
        seconds: f64,
    ) -> PyResult<Answer<'py>> {
        let request = self.request(Operation::Observe, first_robot, n_robots, flags);
        self.ask(py, request, &[], seconds)
    }

    /// From here on a world of the lease is at this step.
    fn note(&self, world: u32, step: u64) {
        let mut steps = self.steps.lock().unwrap_or_else(PoisonError::into_inner);
        let index = world.checked_sub(self.worlds.start);
        if let Some(noted) = index.and_then(|index| steps.get_mut(index as usize)) {
            *noted = step;
        }
    }

    /// The step of each world.
    #[getter]
    fn steps(&self) -> Vec<u64> {
        let steps = self.steps.lock();
        steps.unwrap_or_else(PoisonError::into_inner).clone()
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

    fn ask<'py>(
        &self,
        py: Python<'py>,
        request: StepRequest,
        moves: &[u8],
        seconds: f64,
    ) -> PyResult<Answer<'py>> {
        let server = self.server.get();
        // Within the connection's turn: each thread's path is for a step of its own.
        let answer = server.backend.with(py, |backend| {
            let worlds = worlds_of(request.first_robot, request.n_robots, server.team);
            self.exchange(backend, &worlds, request, moves, seconds)
        })?;
        answered(py, answer, seconds)
    }

    fn exchange(
        &self,
        backend: &mut Backend,
        worlds: &Range<u32>,
        request: StepRequest,
        moves: &[u8],
        seconds: f64,
    ) -> Result<(StepReply, Vec<u8>), ConnectionError> {
        let mut body = Vec::new();
        if request.operation == Operation::Step as u32 {
            let steps = self.steps();
            let of = |world| steps[(world - self.worlds.start) as usize];
            let steps: Vec<u64> = worlds.clone().map(of).collect();
            write_step_body(&steps, moves, &mut body);
        }
        let (reply, payload) = backend.step_payload(request, &body, duration(seconds))?;
        for (world, result) in worlds.clone().zip(payload.chunks_exact(WORLD_BYTES)) {
            let result: WorldResult = bytemuck::pod_read_unaligned(result);
            self.note(world, result.step);
        }
        Ok((reply, payload))
    }
}
