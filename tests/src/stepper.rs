//! Steps as fast as the wire allows: a connection and one request, again and again.

use crate::programs::PATIENCE;
use crate::wire::step_header;
use emberwatch_protocol::Connection;
use emberwatch_protocol::connection::StepAnswer;
use emberwatch_protocol::control::{Reply, Request};
use emberwatch_protocol::message::StepRequest;
use emberwatch_protocol::payload::write_step_body;
use std::ops::Range;

/// A connection that holds robots, and the request of their step.
pub struct Stepper {
    pub connection: Connection,
    pub steps: Vec<u64>,
    request: StepRequest,
    body: Vec<u8>,
}

impl Stepper {
    /// Takes robots from their holders.
    pub fn new(mut connection: Connection, robots: Range<u32>) -> Self {
        let (first_robot, n_robots) = (robots.start, robots.len() as u32);
        let acquire = Request::Acquire {
            first_robot,
            n_robots,
            takeover: true,
            ttl_millis: None,
        };
        let lease = match connection.control(&acquire, PATIENCE) {
            Ok(Reply::Lease(lease)) => lease,
            other => panic!("acquire: {other:?}"),
        };
        let n_moves = connection.info().n_moves as u32;
        Self {
            connection,
            steps: lease.worlds.iter().map(|world| world.step).collect(),
            request: StepRequest {
                first_robot,
                n_robots,
                ..step_header(lease.lease, n_moves)
            },
            body: Vec::new(),
        }
    }

    /// Flies paths, one robot's after the other's.
    pub fn step(&mut self, paths: &[u8]) -> StepAnswer {
        self.body.clear();
        write_step_body(&self.steps, paths, &mut self.body);
        let answer = self.connection.step(self.request, &self.body, PATIENCE);
        self.steps.iter_mut().for_each(|step| *step += 1);
        answer.expect("a step")
    }
}
