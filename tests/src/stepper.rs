//! A minimal client that steps as fast as the channel allows, and does not decode the answers.

use crate::programs::PATIENCE;
use emberwatch_protocol::Connection;
use emberwatch_protocol::backend::StepAnswer;
use emberwatch_protocol::control::{Reply, Request};
use emberwatch_protocol::lease::{Call, Lease};
use emberwatch_protocol::message::Operation;
use std::ops::Range;

/// A connection and its lease on robots.
pub struct Stepper {
    pub connection: Connection,
    pub lease: Lease,
    robots: Range<u32>,
}

impl Stepper {
    /// Takes robots over from their holders.
    pub fn new(mut connection: Connection, robots: Range<u32>) -> Self {
        let acquire = Request::Acquire {
            first_robot: robots.start,
            n_robots: robots.len() as u32,
            takeover: true,
            ttl_millis: None,
        };
        let given = match connection.control(&acquire, PATIENCE) {
            Ok(Reply::Lease(given)) => given,
            other => panic!("acquire: {other:?}"),
        };
        let lease = Lease::new(connection.info(), given.lease, &robots);
        lease.note_all(&given.worlds);
        Self {
            connection,
            lease,
            robots,
        }
    }

    /// Flies the concatenated paths of all robots.
    pub fn step(&mut self, paths: &[u8]) -> StepAnswer {
        let request = self.lease.request(Operation::Step, &self.robots, 0);
        let mut call = Call::new(request, paths, PATIENCE);
        let answer = self.lease.send(&mut self.connection, &mut call);
        answer.expect("a step")
    }
}
