//! Fuzz targets for the requests that the server reads.

use super::besieged::{
    ATTACKERS, N_MOVES, N_ROBOTS, N_THEIRS, N_WORLDS, SHARED, Siege, WorldSeen, check_answer,
    on_siege, step_request,
};
use super::messages::{Seed, split_header, survives};
use crate::wire::step_body;
use bytemuck::bytes_of;
use emberwatch_protocol::control::{Reply, Request, parse};
use emberwatch_protocol::message::{
    FLAG_FULL_COVERAGE, FLAG_TEAM_FRAMES, Operation, Status, StepRequest, VERSION,
};
use emberwatch_sim::simulator::{Outcome, PendingReply, Stepped};
use std::time::Duration;

/// The placeholder for the attacker's lease in a control request.
const LEASE: &str = "LEASE";

/// Handles a step request, which consists of a header of 56 bytes and a payload. The steps k in the payload are
/// relative to the current steps of the worlds.
pub fn step(bytes: &[u8]) -> bool {
    split_header(bytes).is_some_and(|(request, body)| on_siege(|siege| siege.step(&request, body)))
}

/// Handles a control request. The first byte selects the client, and the events that precede the request.
pub fn control(bytes: &[u8]) -> bool {
    bytes
        .split_first()
        .is_some_and(|(&before, text)| on_siege(|siege| siege.control(before, text)))
}

impl Siege {
    fn step(&mut self, request: &StepRequest, body: &[u8]) -> bool {
        // The attacker has one request at a time, so a new one cancels its waiting request.
        if let Some((given_up, _)) = self.attackers_step.take() {
            self.simulator.cancel_step(self.now, given_up);
        }
        let body = self.body_from_present(request, body);
        let (before, mut payload) = (self.worlds(), Vec::new());
        let stepped = self
            .simulator
            .step(self.now, ATTACKERS[0], request, &body, &mut payload);
        let after = self.worlds();
        let reply = match stepped {
            Stepped::Reply(reply) => reply,
            Stepped::Waits(ticket) => {
                assert!(before == after, "a step that waits changed a world");
                self.attackers_step = Some((ticket, self.now));
                return true;
            }
        };
        let status = check_answer(&reply, &payload);
        assert_eq!(reply.sequence, request.sequence);
        if status != Status::Ok {
            assert!(before == after, "{status:?} changed a world");
            return false;
        }
        let robots = request.first_robot as usize..(request.first_robot + reply.n_robots) as usize;
        let is_step = request.operation == Operation::Step as u32;
        let mut stepped = self.simulator.worlds_of(&robots);
        if is_step {
            assert!(
                robots.end <= N_THEIRS as usize,
                "a step with the victim's robot"
            );
            assert_eq!(request.lease, self.leases[1], "a step without a lease");
        } else {
            stepped = 0..0;
        }
        let k = |seen: &Option<WorldSeen>| seen.as_ref().map(|(result, _)| result.step);
        for (world, (before, after)) in before.iter().zip(&after).enumerate() {
            if stepped.contains(&world) {
                assert_eq!(k(after), k(before).map(|k| k + 1));
            } else {
                assert!(before == after, "world {world} changed");
            }
        }
        true
    }

    /// Replaces the relative steps in a payload by absolute ones, by adding the worlds' current steps.
    fn body_from_present(&self, request: &StepRequest, body: &[u8]) -> Vec<u8> {
        let mut body = body.to_vec();
        let end = u64::from(request.first_robot) + u64::from(request.n_robots);
        let robots = request.first_robot as usize..end as usize;
        if request.operation == Operation::Step as u32 {
            let (steps, _) = body.as_chunks_mut::<8>();
            for (world, step) in self.simulator.worlds_of(&robots).zip(steps) {
                if let Some(episode) = self.simulator.episode(world) {
                    let present = episode.outcome().step;
                    *step = u64::from_ne_bytes(*step)
                        .wrapping_add(present)
                        .to_ne_bytes();
                }
            }
        }
        body
    }

    fn control(&mut self, before: u8, text: &[u8]) -> bool {
        let is_set = |bit: u8| before >> bit & 1 == 1;
        let who = usize::from(is_set(0));
        if is_set(1) {
            self.finish_resets();
        }
        if is_set(5) {
            self.fly_shared();
        }
        if is_set(6) {
            let request = step_request(self.leases[1], N_THEIRS - 1..N_THEIRS);
            self.step(&request, &step_body(&[0], &[before % 4; N_MOVES]));
            self.check_shared();
        }
        if is_set(2) {
            self.now += Duration::from_millis(60);
        }
        if is_set(4) {
            let dead = ATTACKERS[1 - who].pid;
            self.simulator.end_of_process(self.now, dead);
        }
        self.simulator.tick(self.now);
        let version = if is_set(3) { VERSION + 1 } else { VERSION };
        let text = replaced(text, &self.leases[1 + who].to_string());
        let request = parse::<Request>(&text);
        if let Ok(Request::Acquire {
            first_robot,
            n_robots,
            takeover: true,
            ..
        }) = request
            && first_robot.saturating_add(n_robots) > N_THEIRS
        {
            return false; // A takeover of the victim's robots is legal, so it is not tested here.
        }
        if let Ok(request) = &request {
            assert_eq!(survives::<Request>(&text).as_ref(), Some(request));
        }
        let known = self.status();
        match self.ask(ATTACKERS[who], version, &text) {
            Outcome::Pending(jobs, pending) => {
                self.jobs.extend(jobs);
                self.wait_for(who, pending);
                true
            }
            Outcome::Answer(reply) => {
                let text = serde_json::to_vec(&reply).expect("replies serialise");
                assert_eq!(survives::<Reply>(&text), Some(reply.clone()));
                let is_refused = reply.status() != Status::Ok;
                assert!(
                    !is_refused || self.status() == known,
                    "{reply:?} changed a world"
                );
                !is_refused
            }
            Outcome::Changed(worlds, reply) => {
                assert!(worlds.end <= SHARED, "a fork into a world of the victim's");
                assert_eq!(reply.status(), Status::Ok);
                true
            }
            // Simulates a disk failure, so that no file is written or read.
            Outcome::File(_, pending) => {
                self.simulator.cancel_file(self.now, &pending);
                true
            }
            Outcome::Shutdown => {
                assert_eq!(request, Ok(Request::Shutdown {}));
                true
            }
        }
    }

    /// Stores a client's pending request in place of the previous one, because a client has one request at a time.
    fn wait_for(&mut self, who: usize, pending: PendingReply) {
        let client = ATTACKERS[who];
        let mut waiting = self.pending.iter();
        if let Some(index) = waiting.position(|(other, _)| *other == client) {
            let (_, given_up) = self.pending.swap_remove(index);
            self.simulator.cancel_reply(self.now, &given_up);
        }
        self.pending.push((client, pending));
    }
}

/// Replaces the placeholder in a text with the lease.
fn replaced(text: &[u8], lease: &str) -> Vec<u8> {
    let mut words = text.windows(LEASE.len());
    let Some(at) = words.position(|word| word == LEASE.as_bytes()) else {
        return text.to_vec();
    };
    [&text[..at], lease.as_bytes(), &text[at + LEASE.len()..]].concat()
}

pub fn step_seeds() -> Vec<Seed> {
    // The attacker's lease is the third one granted.
    let one = step_request(13, 0..2);
    let both = step_request(13, 0..4);
    let full = StepRequest {
        flags: FLAG_FULL_COVERAGE | FLAG_TEAM_FRAMES,
        ..one
    };
    let observe = StepRequest {
        operation: Operation::Observe as u32,
        n_moves: 0,
        ..step_request(0, 0..N_WORLDS * N_ROBOTS as u32)
    };
    let recall = StepRequest {
        operation: Operation::Recall as u32,
        n_robots: 2,
        ..observe
    };
    let shared = step_request(13, 4..5);
    let victims = step_request(11, 6..8);
    let with = |request: &StepRequest, body: &[u8]| [bytes_of(request), body].concat();
    let paths = [0, 1, 2, 3, 1, 1, 3, 3];
    let of_both = step_body(&[0, 0], &[paths, paths].concat());
    vec![
        ("one_world", with(&one, &step_body(&[0], &paths))),
        ("two_worlds", with(&both, &of_both)),
        ("full_team_frame", with(&full, &step_body(&[0], &paths))),
        ("observe", with(&observe, &[])),
        ("recall", with(&recall, &step_body(&[0], &[]))),
        ("shared", with(&shared, &step_body(&[0], &[3; N_MOVES]))),
        ("stolen_lease", with(&victims, &step_body(&[0], &paths))),
    ]
}
