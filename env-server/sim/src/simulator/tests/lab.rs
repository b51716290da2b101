//! Settings for tests, and a simulator with simulated time.

use crate::config::{Checked, ServerConfig};
use crate::simulator::barrier::Ticket;
use crate::simulator::lease::ClientId;
use crate::simulator::outcome::{Outcome, PendingReply, ServerStats};
use crate::simulator::state::{ResetJob, Simulator};
use crate::simulator::step::Stepped;
use crate::snapshot::{SnapshotWorld, encode};
use crate::world::{Episode, Flown};
use emberwatch_messages::control::{LeaseInfo, Reply, Request};
use emberwatch_messages::message::{
    FLAG_TEAM_FRAMES, Operation, Status, StepReply, StepRequest, VERSION,
};
use emberwatch_messages::payload::{split_step_payload, write_step_body};
use emberwatch_model::Move;
use rayon::ThreadPoolBuilder;
use serde_json::{Value, json};
use std::ops::Range;
use std::time::{Duration, Instant};

const N_MOVES: usize = 2;
pub const LEASE: Duration = Duration::from_secs(20);

/// Two worlds of three robots each.
pub struct Lab {
    pub simulator: Simulator,
    pub now: Instant,
    /// The newest lease of each client, by process id.
    pub leases: [u64; 5],
}

/// Returns the usual settings, with those of `given` replaced by name.
pub fn settings(given: Value) -> Checked {
    let given = given.as_object().expect("a dictionary");
    let config = ServerConfig::default().with(given).expect("known settings");
    config.check().expect("valid settings")
}

pub fn client(pid: u32) -> ClientId {
    let node = u128::from(pid);
    ClientId { node, pid }
}

fn path(robot: u32) -> [u8; N_MOVES] {
    [(robot % 4) as u8, (robot / 2 % 4) as u8]
}

pub fn claim(robots: Range<u32>, takeover: bool, ttl_millis: Option<u64>) -> Request {
    Request::Acquire {
        first_robot: robots.start,
        n_robots: robots.len() as u32,
        takeover,
        ttl_millis,
    }
}

impl Lab {
    /// Creates worlds in their first burn-in, and the jobs that end it. The token of the first lease is 1.
    pub fn in_burn_in(deadline: Duration) -> (Self, Vec<ResetJob>) {
        let threads = ThreadPoolBuilder::new().num_threads(1).build();
        let mut token = 0;
        let next_token = Box::new(move || {
            token += 1;
            token
        });
        let checked = settings(json!({
            "worlds": 2, "robots": 3, "height": 4, "width": 5, "moves": N_MOVES, "burn_in": 200,
            "deadline_millis": deadline.as_millis() as u64, "lease_millis": LEASE.as_millis() as u64,
        }));
        let simulator = Simulator::new(checked, threads.expect("a thread"), next_token);
        let (simulator, jobs) = simulator.expect("a valid model");
        let (now, leases) = (Instant::now(), [0; 5]);
        let lab = Self {
            simulator,
            now,
            leases,
        };
        (lab, jobs)
    }

    pub fn new(deadline: Duration) -> Self {
        let (mut lab, jobs) = Self::in_burn_in(deadline);
        lab.finish(jobs);
        lab
    }

    /// Starts three clients, 1 to 3. Client r + 1 holds robot r of world 0.
    pub fn of_three(deadline: Duration) -> Self {
        let mut lab = Self::new(deadline);
        for robot in 0..3 {
            lab.acquire(robot + 1, robot..robot + 1, false);
        }
        lab
    }

    pub fn finish(&mut self, jobs: Vec<ResetJob>) {
        for job in jobs {
            let (world, episode) = job.run(&self.simulator.spec().rules);
            self.simulator.put(world, episode);
        }
    }

    fn outcome(&mut self, pid: u32, request: &Request) -> Outcome {
        let text = serde_json::to_vec(request).expect("requests serialise");
        let stats = ServerStats::default();
        self.simulator
            .control(self.now, client(pid), VERSION, &text, &stats)
    }

    /// Returns the jobs and the answer for which a request waits.
    pub fn wait(&mut self, pid: u32, request: &Request) -> (Vec<ResetJob>, PendingReply) {
        match self.outcome(pid, request) {
            Outcome::Pending(jobs, pending) => (jobs, pending),
            _ => panic!("{request:?} is not answered later"),
        }
    }

    pub fn reply(&mut self, pending: &PendingReply) -> Option<Reply> {
        self.simulator.pending_reply(self.now, pending)
    }

    pub fn ask(&mut self, pid: u32, request: &Request) -> Reply {
        match self.outcome(pid, request) {
            Outcome::Answer(reply) | Outcome::Changed(_, reply) => reply,
            Outcome::Pending(jobs, pending) => {
                self.finish(jobs);
                self.reply(&pending).expect("ready")
            }
            _ => panic!("{request:?}: expected an answer"),
        }
    }

    pub fn ask_for_lease(&mut self, pid: u32, request: &Request) -> LeaseInfo {
        match self.ask(pid, request) {
            Reply::Lease(lease) => lease,
            other => panic!("expected a lease, got {other:?}"),
        }
    }

    pub fn acquire(&mut self, pid: u32, robots: Range<u32>, takeover: bool) {
        let lease = self.ask_for_lease(pid, &claim(robots, takeover, None));
        self.leases[pid as usize] = lease.lease;
    }

    pub fn release(&mut self, pid: u32) {
        let lease = self.leases[pid as usize];
        assert_eq!(self.ask(pid, &Request::Release { lease }), Reply::Done);
    }

    pub fn request(
        &mut self,
        pid: u32,
        operation: Operation,
        robots: Range<u32>,
        body: &[u8],
    ) -> (Stepped, Vec<u8>) {
        let is_step = operation == Operation::Step;
        let request = StepRequest {
            version: VERSION,
            operation: operation as u32,
            lease: self.leases[pid as usize],
            first_robot: robots.start,
            n_robots: robots.len() as u32,
            n_moves: if is_step { N_MOVES as u32 } else { 0 },
            flags: FLAG_TEAM_FRAMES,
            ..StepRequest::default()
        };
        let (client, mut payload) = (client(pid), Vec::new());
        let stepped = (self.simulator).step(self.now, client, &request, body, &mut payload);
        (stepped, payload)
    }

    fn fly(&mut self, pid: u32, robots: Range<u32>, k: u64) -> Stepped {
        let paths: Vec<u8> = robots.clone().flat_map(path).collect();
        let of_worlds = robots.start as usize..robots.end as usize;
        let worlds = self.simulator.worlds_of(&of_worlds);
        let mut body = Vec::new();
        write_step_body(&vec![k; worlds.len()], &paths, &mut body);
        self.request(pid, Operation::Step, robots, &body).0
    }

    pub fn waits(&mut self, pid: u32, robots: Range<u32>, k: u64) -> Ticket {
        match self.fly(pid, robots, k) {
            Stepped::Waits(ticket) => ticket,
            Stepped::Reply(reply) => panic!("expected a ticket, got {reply:?}"),
        }
    }

    pub fn replies(&mut self, pid: u32, robots: Range<u32>, k: u64) -> (Status, u64) {
        status_and_detail(&replied(self.fly(pid, robots, k)))
    }

    /// Returns the answers to waiting requests: ticket, status, and the new step or the refusal's detail.
    pub fn answers(&mut self) -> Vec<(Ticket, Status, u64)> {
        let mut payload = Vec::new();
        let mut answers = Vec::new();
        while let Some((ticket, reply)) = self.simulator.next_answer(&mut payload) {
            let parts =
                split_step_payload(&reply, &payload).expect("a length that fits the header");
            let (status, detail) = status_and_detail(&reply);
            let step = parts.worlds.first().map_or(detail, |world| world.step);
            answers.push((ticket, status, step));
        }
        answers
    }

    pub fn episode(&self) -> &Episode {
        self.simulator.episode(0).expect("ready")
    }

    /// Checks that world 0 equals a world that is stepped directly. `steps` contains, for each step, the masks of the
    /// robots that fly, hover and are late.
    pub fn assert_is_as_after(&self, steps: &[(u64, u64, u64)]) {
        let spec = self.simulator.spec();
        let mut expected = Episode::new(&spec.rules, 0);
        let moves: Vec<Move> = (0..3)
            .flat_map(path)
            .map(|byte| Move::from_low_bits(byte.into()))
            .collect();
        for &(ready, hovered, late) in steps {
            let flown = Flown {
                moves: &moves,
                ready,
                hovered,
                late,
                full: 0,
            };
            expected.step(&spec.rules, &flown);
        }
        let got = self.episode();
        assert_eq!(got.outcome(), expected.outcome());
        let bytes = |episode| encode(&spec.settings, &[SnapshotWorld::Ready(episode)]);
        assert_eq!(bytes(got).expect("small"), bytes(&expected).expect("small"));
    }
}

pub fn replied(stepped: Stepped) -> StepReply {
    match stepped {
        Stepped::Reply(reply) => reply,
        Stepped::Waits(_) => panic!("expected an answer, got a ticket"),
    }
}

pub fn status_and_detail(reply: &StepReply) -> (Status, u64) {
    let status = Status::try_from(reply.status).expect("a known status");
    (status, reply.detail)
}
