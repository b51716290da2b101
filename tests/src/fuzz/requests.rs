//! What the server reads: requests of attackers, while a victim acts on a world of its own.
//!
//! A simulator is kept from one input to the next, so that leases, resets and episodes come to every
//! state, and begins again after some inputs, so that few of them cause a failure.

use super::messages::{split_header, survives};
use super::target::Seed;
use bytemuck::bytes_of;
use env_server::config::ServerConfig;
use env_server::simulator::{ClientId, Outcome, PendingReply, ResetJob, ServerStats, Simulator};
use protocol::control::{CoverageRule, Reply, Request, WorldStatus, parse};
use protocol::message::{
    FLAG_FULL_COVERAGE, Operation, RESULT_BYTES, Status, StepReply, StepRequest, StepResult,
    VERSION,
};
use rayon::ThreadPoolBuilder;
use std::cell::RefCell;
use std::sync::OnceLock;
use std::time::{Duration, Instant};

/// Cells of the grid.
const N_CELLS: usize = 2 * 3;

/// Moves of a path.
const N_MOVES: usize = 4;

/// Worlds; the last is the victim's.
const N_WORLDS: u32 = 4;

/// The victim's world.
const HOME: usize = N_WORLDS as usize - 1;

/// Inputs that one simulator gets.
const N_INPUTS: usize = 256;

/// Of so many inputs, the victim steps after one.
const VICTIM_STEPS: usize = 8;

/// The one client whose world must not notice anything.
const VICTIM: ClientId = ClientId { node: 1, pid: 1 };

/// The others.
const ATTACKERS: [ClientId; 2] = [ClientId { node: 2, pid: 2 }, ClientId { node: 3, pid: 3 }];

/// What stands for the attacker's lease in a control request.
const LEASE: &str = "LEASE";

/// A simulator, its clock, and what waits.
struct Siege {
    simulator: Simulator,
    now: Instant,
    jobs: Vec<ResetJob>,
    pending: Vec<(ClientId, PendingReply)>,
    /// The victim's lease, then the attackers' last.
    leases: [u64; 3],
    n_inputs: usize,
}

/// A step request, 64 bytes, and its paths.
pub fn step(bytes: &[u8]) -> bool {
    split_header(bytes)
        .is_some_and(|(request, paths)| on_siege(|siege| siege.step(&request, paths)))
}

/// A byte that says who asks and what happened before, and a control request.
pub fn control(bytes: &[u8]) -> bool {
    bytes
        .split_first()
        .is_some_and(|(&before, text)| on_siege(|siege| siege.control(before, text)))
}

fn on_siege(input: impl FnOnce(&mut Siege) -> bool) -> bool {
    thread_local! { static SIEGE: RefCell<Option<Siege>> = const { RefCell::new(None) } }
    SIEGE.with_borrow_mut(|kept| {
        kept.take_if(|siege| siege.n_inputs == N_INPUTS);
        let siege = kept.get_or_insert_with(Siege::begin);
        let is_accepted = input(siege);
        siege.n_inputs += 1;
        if siege.n_inputs % VICTIM_STEPS == 0 {
            siege.victim_steps();
        }
        is_accepted
    })
}

impl Siege {
    /// The victim and the first attacker hold their worlds.
    fn begin() -> Self {
        let config = ServerConfig {
            worlds: N_WORLDS,
            height: 2,
            width: 3,
            moves: N_MOVES,
            burn_in: 0,
            max_steps: 40,
            coverage: CoverageRule::Client,
            ..ServerConfig::default()
        };
        let threads = ThreadPoolBuilder::new()
            .num_threads(1)
            .build()
            .expect("a thread");
        let mut token = 10;
        let next_token = Box::new(move || {
            token += 1;
            token
        });
        let checked = config.check().expect("valid settings");
        let (simulator, jobs) =
            Simulator::new(checked, threads, next_token).expect("valid settings");
        let (now, pending) = (Instant::now(), Vec::new());
        let mut siege = Self {
            simulator,
            now,
            jobs,
            pending,
            leases: [0; 3],
            n_inputs: 0,
        };
        siege.finish_resets();
        for (who, client, worlds) in [(0, VICTIM, (HOME, 1)), (1, ATTACKERS[0], (0, HOME))] {
            let (first_world, n_worlds) = worlds;
            let text = format!(
                r#"{{"op":"acquire","first_world":{first_world},"n_worlds":{n_worlds},"ttl_millis":86400000}}"#
            );
            let Outcome::Pending(_, pending) = siege.ask(client, VERSION, text.as_bytes()) else {
                panic!("the worlds are free");
            };
            siege.answer(who, &pending);
        }
        siege
    }

    fn ask(&mut self, client: ClientId, version: u32, text: &[u8]) -> Outcome {
        self.simulator
            .control(self.now, client, version, text, &ServerStats::default())
    }

    fn step(&mut self, request: &StepRequest, paths: &[u8]) -> bool {
        let (before, mut payload) = (self.worlds(), Vec::new());
        let reply = self
            .simulator
            .step(self.now, ATTACKERS[0], request, paths, &mut payload);
        let after = self.worlds();
        let status = Status::try_from(reply.status).expect("a known status");
        assert_eq!((reply.version, reply.sequence), (VERSION, request.sequence));
        assert_eq!(
            payload.len(),
            reply.n_worlds as usize * (RESULT_BYTES + N_CELLS)
        );
        if status != Status::Ok {
            assert!(payload.is_empty(), "a refusal has no payload");
            assert!(before == after, "{status:?} changed a world");
            return false;
        }
        let stepped = match request.operation == Operation::Step as u32 {
            true => self.simulator.worlds_of(&reply),
            false => 0..0,
        };
        assert!(stepped.end <= HOME, "a step of the victim's world");
        assert!(
            stepped.is_empty() || request.lease == self.leases[1],
            "a step without a lease"
        );
        for (world, (before, after)) in before.iter().zip(&after).enumerate() {
            let n_steps = u64::from(stepped.contains(&world));
            assert_eq!(after.0.step, before.0.step + n_steps);
            assert!(n_steps == 1 || before == after, "world {world} changed");
        }
        true
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
        if is_set(6) {
            self.simulator.end_of_process(ATTACKERS[1 - who].pid);
        }
        self.simulator.expire(self.now);
        let version = if is_set(3) { VERSION + 1 } else { VERSION };
        let text = replaced(text, &self.leases[1 + who].to_string());
        let request = parse::<Request>(&text);
        if let Ok(Request::Acquire {
            first_world,
            n_worlds,
            takeover: true,
            ..
        }) = request
            && (first_world..first_world.saturating_add(n_worlds)).contains(&(HOME as u32))
        {
            return false; // Everybody may take any world over, also the victim's.
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
            // No file is written or read: as if the disk had failed.
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

    /// Keeps what a client waits for in place of what it waited for before: one request at a time.
    fn wait_for(&mut self, who: usize, pending: PendingReply) {
        let client = ATTACKERS[who];
        let given_up = self
            .pending
            .iter()
            .position(|(waiting, _)| *waiting == client);
        if let Some(index) = given_up {
            let (_, given_up) = self.pending.swap_remove(index);
            self.simulator.cancel_reply(self.now, &given_up);
        }
        self.pending.push((client, pending));
    }

    /// Runs the resets, and answers the clients that waited for them.
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

    /// Results and frames of the worlds that are ready.
    fn worlds(&self) -> Vec<(StepResult, Vec<u8>)> {
        let episodes = self
            .simulator
            .worlds()
            .filter_map(|world| self.simulator.episode(world));
        episodes
            .map(|episode| (*episode.result(), episode.frame().as_bytes().to_vec()))
            .collect()
    }

    /// What everybody may know of the worlds.
    fn status(&mut self) -> Vec<WorldStatus> {
        match self.ask(VICTIM, VERSION, br#"{"op":"status"}"#) {
            Outcome::Answer(Reply::Status(status)) => status.worlds,
            _ => panic!("everybody may ask for the status"),
        }
    }

    /// Steps the victim's world, which must go as if nobody else were there.
    fn victim_steps(&mut self) {
        static QUIET: OnceLock<Vec<(StepReply, Vec<u8>)>> = OnceLock::new();
        let steps = QUIET.get_or_init(|| {
            let mut quiet = Siege::begin();
            (0..N_INPUTS / VICTIM_STEPS)
                .map(|number| quiet.victim_step(number))
                .collect()
        });
        let number = self.n_inputs / VICTIM_STEPS - 1;
        assert!(
            self.victim_step(number) == steps[number],
            "the victim's step {number} differs"
        );
    }

    fn victim_step(&mut self, number: usize) -> (StepReply, Vec<u8>) {
        let (request, mut payload) = (step_request(self.leases[0], HOME as u32, 1), Vec::new());
        let path = [0, 1, 2, 3].map(|turn| ((number * 7 + turn * 5) % 4) as u8);
        let reply = self
            .simulator
            .step(self.now, VICTIM, &request, &path, &mut payload);
        assert_eq!(Status::try_from(reply.status), Ok(Status::Ok));
        (reply, payload)
    }
}

/// A text with the lease in its place.
fn replaced(text: &[u8], lease: &str) -> Vec<u8> {
    match text
        .windows(LEASE.len())
        .position(|word| word == LEASE.as_bytes())
    {
        Some(at) => [&text[..at], lease.as_bytes(), &text[at + LEASE.len()..]].concat(),
        None => text.to_vec(),
    }
}

fn step_request(lease: u64, first_world: u32, n_worlds: u32) -> StepRequest {
    StepRequest {
        version: VERSION,
        operation: Operation::Step as u32,
        lease,
        sequence: 7,
        first_world,
        n_worlds,
        n_moves: N_MOVES as u32,
        ..StepRequest::default()
    }
}

pub fn step_seeds() -> Vec<Seed> {
    // The attacker's lease is the second that is given.
    let one = step_request(12, 0, 1);
    let all = step_request(12, 0, HOME as u32);
    let full = StepRequest {
        flags: FLAG_FULL_COVERAGE,
        ..one
    };
    let observe = StepRequest {
        operation: Operation::Observe as u32,
        n_moves: 0,
        ..step_request(0, 0, N_WORLDS)
    };
    let recall = StepRequest {
        operation: Operation::Recall as u32,
        step: 1,
        ..observe
    };
    let victims = step_request(11, HOME as u32, 1);
    vec![
        ("one_world", [bytes_of(&one), &[0, 1, 2, 3]].concat()),
        ("three_worlds", [bytes_of(&all), &[3; 3 * N_MOVES]].concat()),
        ("full_frame", [bytes_of(&full), &[1, 1, 3, 3]].concat()),
        ("observe", bytes_of(&observe).to_vec()),
        ("recall", bytes_of(&recall).to_vec()),
        ("stolen_lease", [bytes_of(&victims), &[0; N_MOVES]].concat()),
    ]
}

pub fn control_seeds() -> Vec<Seed> {
    let texts = [
        (
            "hello",
            r#"0{"op":"hello","protocol":1,"client":"fuzz 0.1"}"#,
        ),
        (
            "acquire",
            r#"0{"op":"acquire","first_world":0,"n_worlds":2,"ttl_millis":100}"#,
        ),
        (
            "takeover",
            r#"3{"op":"acquire","first_world":1,"n_worlds":1,"takeover":true,"ttl_millis":null}"#,
        ),
        ("renew", r#"6{"op":"renew","lease":LEASE}"#),
        ("release", r#"2{"op":"release","lease":LEASE}"#),
        (
            "reset",
            r#"2{"op":"reset","lease":LEASE,"worlds":[{"world":1,"seed":3},{"world":0}]}"#,
        ),
        ("reset_none", r#"4{"op":"reset","lease":LEASE,"worlds":[]}"#),
        (
            "snapshot",
            r#"0{"op":"snapshot","first_world":0,"n_worlds":4,"path":"/a"}"#,
        ),
        (
            "restore",
            r#"2{"op":"restore","lease":LEASE,"first_world":0,"n_worlds":2,"from":1,"path":"/a"}"#,
        ),
        ("fork", r#"2{"op":"fork","lease":LEASE,"from":3,"to":1}"#),
        (
            "leave_belief",
            r#"2{"op":"leave_belief","lease":LEASE,"world":0,"episode":0,"step":0,"kind":"k","offset":0,"length":2,"data":"AAE="}"#,
        ),
        ("belief", r#"2{"op":"belief","world":0,"offset":0}"#),
        ("status", r#"p{"op":"status"}"#),
        ("shutdown", r#"0{"op":"shutdown"}"#),
    ];
    texts.map(|(name, text)| (name, text.into())).to_vec()
}
