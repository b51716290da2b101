//! A hostile client that sends random numbers, random bytes and mutated requests.

use crate::harness::PATIENCE;
use crate::wire::{RawClient, Wire, answer, step_body};
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::control::Reply;
use emberwatch_protocol::message::{
    ControlRequest, FLAG_FULL_COVERAGE, FLAG_TEAM_FRAMES, Status, StepRequest, VERSION,
};
use emberwatch_protocol::payload::split_step_payload;
use rand::RngExt;
use rand::seq::IndexedRandom;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

/// One control request of each kind. Shutdown, takeovers and file requests are excluded, because any client may use
/// these.
const TEMPLATES: [&str; 8] = [
    r#"{"op":"hello","protocol":3,"client":"x"}"#,
    r#"{"op":"acquire","first_robot":1,"n_robots":1}"#,
    r#"{"op":"acquire","first_robot":0,"n_robots":2,"ttl_millis":100}"#,
    r#"{"op":"renew","lease":LEASE}"#,
    r#"{"op":"release","lease":LEASE}"#,
    r#"{"op":"reset","lease":LEASE,"worlds":[{"world":1,"seed":3}]}"#,
    r#"{"op":"reset","lease":LEASE,"worlds":[{"world":0},{"world":1},{"world":1}]}"#,
    r#"{"op":"status"}"#,
];

/// A client that sends invalid requests.
pub struct Attacker {
    wire: Wire,
    rng: ChaCha8Rng,
    /// Lease tokens for requests: none, the attacker's and the victim's.
    leases: Vec<u64>,
    /// The latest step that an answer reported.
    k: u64,
    pub n_refused: u64,
    pub n_accepted: u64,
}

impl Attacker {
    /// Creates an attacker that holds robot 1 and knows another client's lease.
    pub fn new(instance: &Instance, stolen: u64, seed: u64) -> Self {
        let wire = Wire::open(instance);
        let own = wire.acquire(1..2).lease;
        Self {
            wire,
            rng: ChaCha8Rng::seed_from_u64(seed),
            leases: vec![0, own, own, own, stolen, u64::MAX],
            k: 0,
            n_refused: 0,
            n_accepted: 0,
        }
    }

    /// Sends one message, and usually waits for the answer.
    pub fn strike(&mut self) {
        let status = if self.rng.random() {
            self.strike_step()
        } else {
            self.strike_control()
        };
        match status {
            None => {}
            Some(0) => self.n_accepted += 1,
            Some(code) => {
                assert!(Status::try_from(code).is_ok(), "unknown status {code}");
                self.n_refused += 1;
            }
        }
    }

    /// Sends a step request. Returns the answer's status if it waits for one.
    fn strike_step(&mut self) -> Option<u32> {
        let header = StepRequest {
            version: self.number(VERSION),
            operation: self.number(1),
            lease: *self.leases.choose(&mut self.rng)?,
            sequence: self.rng.random(),
            first_robot: self.number(1),
            n_robots: self.number(1),
            n_moves: self.number(6),
            flags: self.number(0),
            listener_low: self.rng.random(),
            listener_high: self.rng.random(),
        };
        let payload = match self.rng.random_range(0..4) {
            0 => self.bytes(300),
            _ => step_body(&[self.k], &[(self.k % 4) as u8; 6]),
        };
        let pending = self.wire.send_step(header, &payload).expect("send");
        if self.rng.random_ratio(1, 8) {
            return None;
        }
        let (reply, payload) = answer(&pending, PATIENCE).expect("an answer");
        assert_eq!(reply.sequence, header.sequence);
        assert_eq!(payload.is_empty(), reply.status != 0);
        let parts = split_step_payload(&reply, &payload).expect("a whole payload");
        if let [world] = parts.worlds[..] {
            self.k = world.step;
        }
        if [Status::Late as u32, Status::Early as u32].contains(&reply.status) {
            self.k = reply.detail;
        }
        Some(reply.status)
    }

    fn strike_control(&mut self) -> Option<u32> {
        let header = ControlRequest {
            version: self.number(VERSION),
            reserved: self.rng.random(),
            sequence: self.rng.random(),
            listener_low: self.rng.random(),
            listener_high: self.rng.random(),
        };
        let lease = self.leases.choose(&mut self.rng)?.to_string();
        let text = TEMPLATES.choose(&mut self.rng)?;
        let mut text = text.replace("LEASE", &lease).into_bytes();
        for _ in 0..self.rng.random_range(0..3) {
            let at = self.rng.random_range(0..text.len());
            match self.rng.random_range(0..3) {
                0 => text[at] = self.rng.random(),
                1 => text.truncate(at.max(1)),
                _ => text.insert(at, b"0123456789{}[]\",:-"[self.rng.random_range(0..18)]),
            }
        }
        let pending = self.wire.send_control(header, &text).expect("send");
        if self.rng.random_ratio(1, 8) {
            return None;
        }
        let (reply, payload) = answer(&pending, PATIENCE).expect("an answer");
        assert_eq!(reply.sequence, header.sequence);
        let parsed: Reply = serde_json::from_slice(&payload).expect("a reply");
        if let Reply::Lease(lease) = &parsed {
            self.leases[1..4].fill(lease.lease);
        }
        assert_eq!(parsed.status() as u32, reply.status);
        Some(reply.status)
    }

    /// Returns `right` in most cases, and otherwise a number that is off by one, huge or random.
    fn number(&mut self, right: u32) -> u32 {
        match self.rng.random_range(0..50) {
            0 => right.wrapping_add(1),
            1 => right.wrapping_sub(1),
            2 => u32::MAX,
            3 => self.rng.random(),
            4 => FLAG_FULL_COVERAGE,
            5 => FLAG_TEAM_FRAMES,
            _ => right,
        }
    }

    fn bytes(&mut self, most: usize) -> Vec<u8> {
        let mut bytes = vec![0; self.rng.random_range(0..most)];
        self.rng.fill_bytes(&mut bytes);
        bytes
    }
}
