//! Fuzz targets for the requests that the server reads.
//!
//! Successive inputs go to the same simulator, so that leases, resets and episodes reach every state. After some inputs
//! a new simulator replaces it, so that a failure can be reproduced from few inputs.

use super::messages::{Seed, split_header, survives};
use crate::wire::{step_body, step_header};
use bytemuck::bytes_of;
use emberwatch_protocol::control::{CoverageRule, Reply, Request, WorldStatus, parse};
use emberwatch_protocol::message::{
    FLAG_FULL_COVERAGE, FLAG_TEAM_FRAMES, Operation, RobotResult, Status, StepReply, StepRequest,
    VERSION, WorldResult,
};
use emberwatch_protocol::payload::split_step_payload;
use emberwatch_protocol::settings::WorldSettings;
use emberwatch_sim::config::ServerConfig;
use emberwatch_sim::results::{robot_result, world_result};
use emberwatch_sim::simulator::{
    ClientId, Outcome, PendingReply, ResetJob, ServerStats, Simulator, Stepped, Ticket,
};
use emberwatch_sim::world::{Episode, Robot};
use rayon::ThreadPoolBuilder;
use std::cell::RefCell;
use std::ops::Range;
use std::time::{Duration, Instant};

const N_MOVES: usize = 4;
const N_ROBOTS: u32 = 2;

/// The worlds of the attackers come first. The last world is the victim's.
const N_WORLDS: u32 = 3;
const HOME: usize = 2;

/// Number of robots that the attackers hold, from robot 0 on.
const N_THEIRS: u32 = HOME as u32 * N_ROBOTS;

/// Number of inputs after which the simulator is replaced.
const N_INPUTS: usize = 256;

/// Number of inputs from one step of the victim to the next.
const VICTIM_STEPS: usize = 8;

const VICTIM: ClientId = ClientId { node: 1, pid: 1 };

/// The attacking clients. The first one holds the attackers' robots.
const ATTACKERS: [ClientId; 2] = [ClientId { node: 2, pid: 2 }, ClientId { node: 3, pid: 3 }];

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

/// A simulator under attack, with the simulated clock and the requests that wait.
struct Siege {
    simulator: Simulator,
    now: Instant,
    jobs: Vec<ResetJob>,
    pending: Vec<(ClientId, PendingReply)>,
    /// The leases of the victim and of the attackers, the latest ones.
    leases: [u64; 3],
    attackers_step: Option<Ticket>,
    n_inputs: usize,
}

/// The result of a world, and the result and frame of each of its robots.
type WorldSeen = (WorldResult, Vec<(RobotResult, Vec<u8>)>);

/// Gives one input to the simulator, which must not change the victim's world. Now and then the victim steps its world.
fn on_siege(input: impl FnOnce(&mut Siege) -> bool) -> bool {
    thread_local! { static SIEGE: RefCell<Option<Siege>> = const { RefCell::new(None) } }
    SIEGE.with_borrow_mut(|kept| {
        kept.take_if(|siege| siege.n_inputs == N_INPUTS);
        let siege = kept.get_or_insert_with(Siege::begin);
        let before = siege.worlds().swap_remove(HOME);
        let is_accepted = input(siege);
        siege.receive_answers();
        let after = siege.worlds().swap_remove(HOME);
        assert!(before == after, "the victim's world changed");
        siege.n_inputs += 1;
        if siege.n_inputs % VICTIM_STEPS == 0 {
            siege.victim_steps();
        }
        is_accepted
    })
}

impl Siege {
    /// Creates the simulator, in which the victim and the first attacker hold their robots.
    fn begin() -> Self {
        let config = ServerConfig {
            worlds: N_WORLDS,
            deadline_millis: 50,
            coverage: CoverageRule::Client,
            world: WorldSettings {
                robots: N_ROBOTS,
                height: 2,
                width: 3,
                moves: N_MOVES,
                burn_in: 0,
                max_steps: 40,
                ..WorldSettings::default()
            },
            ..ServerConfig::default()
        };
        let threads = ThreadPoolBuilder::new().num_threads(1).build();
        let mut tokens = 11..;
        let next_token = Box::new(move || tokens.next().expect("numbers"));
        let checked = config.check().expect("valid settings");
        let simulator = Simulator::new(checked, threads.expect("a thread"), next_token);
        let (simulator, jobs) = simulator.expect("valid settings");
        let mut siege = Self {
            simulator,
            now: Instant::now(),
            jobs,
            pending: Vec::new(),
            leases: [0; 3],
            attackers_step: None,
            n_inputs: 0,
        };
        siege.finish_resets();
        for (who, client, robots) in [
            (0, VICTIM, N_THEIRS..N_THEIRS + N_ROBOTS),
            (1, ATTACKERS[0], 0..N_THEIRS),
        ] {
            let (first_robot, n_robots) = (robots.start, robots.len());
            let robots = format!(r#""first_robot":{first_robot},"n_robots":{n_robots}"#);
            let text = format!(r#"{{"op":"acquire",{robots},"ttl_millis":86400000}}"#);
            let Outcome::Pending(_, pending) = siege.ask(client, VERSION, text.as_bytes()) else {
                panic!("the robots are free");
            };
            siege.answer(who, &pending);
        }
        siege
    }

    fn ask(&mut self, client: ClientId, version: u32, text: &[u8]) -> Outcome {
        self.simulator
            .control(self.now, client, version, text, &ServerStats::default())
    }

    /// Runs the pending resets and answers the clients that waited for them.
    fn finish_resets(&mut self) {
        for job in std::mem::take(&mut self.jobs) {
            let (world, episode) = job.run(&self.simulator.spec().rules);
            self.simulator.put(world, episode);
        }
        for (client, pending) in std::mem::take(&mut self.pending) {
            self.answer(usize::from(client == ATTACKERS[1]) + 1, &pending);
        }
    }

    fn answer(&mut self, who: usize, pending: &PendingReply) {
        let reply = self.simulator.pending_reply(self.now, pending);
        if let Reply::Lease(lease) = reply.expect("all worlds are ready") {
            self.leases[who] = lease.lease;
        }
    }

    /// Returns the results and frames of all worlds, or `None` for a world in its burn-in.
    fn worlds(&self) -> Vec<Option<WorldSeen>> {
        let worlds = self.simulator.worlds();
        let episodes = worlds.map(|world| self.simulator.episode(world));
        episodes.map(|episode| episode.map(seen)).collect()
    }

    /// Returns the public status of the worlds.
    fn status(&mut self) -> Vec<WorldStatus> {
        match self.ask(VICTIM, VERSION, br#"{"op":"status"}"#) {
            Outcome::Answer(Reply::Status(status)) => status.worlds,
            _ => panic!("everybody may ask for the status"),
        }
    }

    /// Steps the victim's world.
    fn victim_steps(&mut self) {
        let k = (self.n_inputs / VICTIM_STEPS - 1) as u64;
        let request = step_request(self.leases[0], N_THEIRS..N_THEIRS + N_ROBOTS);
        let body = step_body(&[k], &[(k % 4) as u8; N_MOVES * N_ROBOTS as usize]);
        let (simulator, mut payload) = (&mut self.simulator, Vec::new());
        match simulator.step(self.now, VICTIM, &request, &body, &mut payload) {
            Stepped::Reply(reply) => assert_eq!(check_answer(&reply, &payload), Status::Ok),
            Stepped::Waits(_) => panic!("the victim holds all robots of its world"),
        }
    }

    /// Receives the answers to step requests that waited.
    fn receive_answers(&mut self) {
        let mut payload = Vec::new();
        while let Some((ticket, reply)) = self.simulator.next_answer(&mut payload) {
            check_answer(&reply, &payload);
            assert_eq!(self.attackers_step.take(), Some(ticket));
        }
    }

    fn step(&mut self, request: &StepRequest, body: &[u8]) -> bool {
        // The attacker has one request at a time, so a new one cancels its waiting request.
        if let Some(given_up) = self.attackers_step.take() {
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
                self.attackers_step = Some(ticket);
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
                assert!(worlds.end <= HOME, "a fork into the victim's world");
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

fn seen(episode: &Episode) -> WorldSeen {
    let seen = |robot: &Robot| {
        let frame = robot.frame().as_bytes().to_vec();
        (robot_result(robot.outcome()), frame)
    };
    let robots = episode.robots().iter().map(seen);
    (world_result(episode.outcome()), robots.collect())
}

/// Checks that an answer is complete and that a refusal is empty.
fn check_answer(reply: &StepReply, payload: &[u8]) -> Status {
    assert_eq!(reply.version, VERSION);
    let parts = split_step_payload(reply, payload).expect("as long as its header says");
    let status = Status::try_from(reply.status).expect("a known status");
    assert_eq!(parts.worlds.is_empty(), status != Status::Ok, "{status:?}");
    status
}

fn step_request(lease: u64, robots: Range<u32>) -> StepRequest {
    StepRequest {
        sequence: 7,
        first_robot: robots.start,
        n_robots: robots.len() as u32,
        ..step_header(lease, N_MOVES as u32)
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
    // The attacker's lease is the second one granted.
    let one = step_request(12, 0..2);
    let both = step_request(12, 0..4);
    let full = StepRequest {
        flags: FLAG_FULL_COVERAGE | FLAG_TEAM_FRAMES,
        ..one
    };
    let observe = StepRequest {
        operation: Operation::Observe as u32,
        n_moves: 0,
        ..step_request(0, 0..N_WORLDS * N_ROBOTS)
    };
    let recall = StepRequest {
        operation: Operation::Recall as u32,
        n_robots: 2,
        ..observe
    };
    let victims = step_request(11, 4..6);
    let with = |request: &StepRequest, body: &[u8]| [bytes_of(request), body].concat();
    let paths = [0, 1, 2, 3, 1, 1, 3, 3];
    let of_both = step_body(&[0, 0], &[paths, paths].concat());
    vec![
        ("one_world", with(&one, &step_body(&[0], &paths))),
        ("two_worlds", with(&both, &of_both)),
        ("full_team_frame", with(&full, &step_body(&[0], &paths))),
        ("observe", with(&observe, &[])),
        ("recall", with(&recall, &step_body(&[0], &[]))),
        ("stolen_lease", with(&victims, &step_body(&[0], &paths))),
    ]
}
