//! What the server reads: requests of attackers, while a victim acts on a world of its own, and shares another with an
//! attacker.
//!
//! A simulator is kept from one input to the next, so that leases, resets and episodes come to every
//! state, and begins again after some inputs, so that few of them cause a failure.

use super::messages::{split_header, survives};
use super::target::Seed;
use bytemuck::bytes_of;
use env_server::config::ServerConfig;
use env_server::simulator::{
    ClientId, Outcome, PendingReply, ResetJob, ServerStats, Simulator, Stepped, Ticket,
};
use env_server::world::{Episode, Flown};
use protocol::control::{CoverageRule, Reply, Request, WorldStatus, parse};
use protocol::message::{
    FLAG_FULL_COVERAGE, FLAG_TEAM_FRAMES, Operation, RobotResult, Status, StepReply, StepRequest,
    VERSION, WorldResult,
};
use protocol::path::path_to_bytes;
use protocol::payload::{split_step_payload, write_step_body};
use protocol::{Coverage, Move};
use rayon::ThreadPoolBuilder;
use std::cell::RefCell;
use std::ops::Range;
use std::sync::OnceLock;
use std::time::{Duration, Instant};

/// Moves of a path.
const N_MOVES: usize = 4;

/// Robots of a world.
const N_ROBOTS: usize = 2;

/// Worlds: the attackers' two, the shared one, the victim's.
const N_WORLDS: u32 = 4;

/// The shared world: its first robot is the attacker's, its second the victim's.
const SHARED: usize = 2;

/// The victim's world.
const HOME: usize = 3;

/// Robots that are the attackers', from 0 on.
const N_THEIRS: u32 = (SHARED * N_ROBOTS + 1) as u32;

/// How long the shared world waits for a path.
const DEADLINE: Duration = Duration::from_millis(50);

/// Inputs that one simulator gets.
const N_INPUTS: usize = 256;

/// Of so many inputs, the victim steps after one.
const VICTIM_STEPS: usize = 8;

/// Who must not notice anything: the victim in its own world, and as a second client in the shared one.
const VICTIM: ClientId = ClientId { node: 1, pid: 1 };
const SHARER: ClientId = ClientId { node: 4, pid: 4 };

/// The others. The first holds the attackers' robots.
const ATTACKERS: [ClientId; 2] = [ClientId { node: 2, pid: 2 }, ClientId { node: 3, pid: 3 }];

/// What stands for the attacker's lease in a control request.
const LEASE: &str = "LEASE";

/// A simulator, its clock, and what waits.
struct Siege {
    simulator: Simulator,
    now: Instant,
    jobs: Vec<ResetJob>,
    pending: Vec<(ClientId, PendingReply)>,
    /// The victim's lease, then the attackers' last, then the victim's in the shared world.
    leases: [u64; 4],
    /// The attacker's step that waits, and since when.
    attackers_step: Option<(Ticket, Instant)>,
    /// The victim's step that waits in the shared world, and its path.
    shared_step: Option<(Ticket, Vec<u8>)>,
    /// The shared world as it must be.
    mirror: Episode,
    n_inputs: usize,
}

/// A world, and each of its robots with its frame.
type WorldSeen = (WorldResult, Vec<(RobotResult, Vec<u8>)>);

/// A step request, 56 bytes, and its payload; steps k count from the present ones of their worlds.
pub fn step(bytes: &[u8]) -> bool {
    split_header(bytes).is_some_and(|(request, body)| on_siege(|siege| siege.step(&request, body)))
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
        siege.check_shared();
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
            robots: N_ROBOTS as u32,
            deadline_millis: DEADLINE.as_millis() as u64,
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
        let mirror = Episode::new(&simulator.spec().rules, SHARED as u64);
        let mut siege = Self {
            simulator,
            now,
            jobs,
            pending,
            leases: [0; 4],
            attackers_step: None,
            shared_step: None,
            mirror,
            n_inputs: 0,
        };
        siege.finish_resets();
        for (who, client, first_robot, n_robots) in [
            (0, VICTIM, HOME * N_ROBOTS, N_ROBOTS),
            (3, SHARER, N_THEIRS as usize, 1),
            (1, ATTACKERS[0], 0, N_THEIRS as usize),
        ] {
            let text = format!(
                r#"{{"op":"acquire","first_robot":{first_robot},"n_robots":{n_robots},"ttl_millis":86400000}}"#
            );
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

    fn step(&mut self, request: &StepRequest, body: &[u8]) -> bool {
        // One request at a time: with the next one it gives up what waits.
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
        let stepped = match request.operation == Operation::Step as u32 {
            true => self.simulator.worlds_of(&robots),
            false => 0..0,
        };
        assert!(
            stepped.is_empty() || robots.end <= N_THEIRS as usize,
            "a step with the victim's robot"
        );
        assert!(
            stepped.is_empty() || request.lease == self.leases[1],
            "a step without a lease"
        );
        for (world, (before, after)) in before.iter().zip(&after).enumerate() {
            let k = |seen: &Option<WorldSeen>| seen.as_ref().map(|(result, _)| result.step);
            match stepped.contains(&world) {
                true => assert_eq!(k(after), k(before).map(|k| k + 1)),
                false => assert!(before == after, "world {world} changed"),
            }
        }
        true
    }

    /// Adds the present steps of the worlds of a step to those in its payload.
    fn body_from_present(&self, request: &StepRequest, body: &[u8]) -> Vec<u8> {
        let mut body = body.to_vec();
        let end = u64::from(request.first_robot) + u64::from(request.n_robots);
        let robots = request.first_robot as usize..end as usize;
        if request.operation == Operation::Step as u32 {
            let (steps, _) = body.as_chunks_mut::<8>();
            for (world, step) in self.simulator.worlds_of(&robots).zip(steps) {
                if let Some(episode) = self.simulator.episode(world) {
                    let present = episode.result().step;
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
            self.step(&request, &step_body(0, &[before % 4; N_MOVES]));
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
            return false; // Everybody may take any robot over, also the victim's.
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

    /// Results and frames of the worlds, but of those in their burn-in.
    fn worlds(&self) -> Vec<Option<WorldSeen>> {
        let worlds = self.simulator.worlds();
        let episodes = worlds.map(|world| self.simulator.episode(world));
        episodes.map(|episode| episode.map(seen)).collect()
    }

    /// What everybody may know of the worlds.
    fn status(&mut self) -> Vec<WorldStatus> {
        match self.ask(VICTIM, VERSION, br#"{"op":"status"}"#) {
            Outcome::Answer(Reply::Status(status)) => status.worlds,
            _ => panic!("everybody may ask for the status"),
        }
    }

    /// Steps the victim's world, which must go as if nobody else were there; and its robot in the shared one.
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
        match self.shared_step.take_if(|_| number % 2 == 1) {
            // What is given up is never flown.
            Some((ticket, _)) => self.simulator.cancel_step(self.now, ticket),
            None => self.fly_shared(),
        }
    }

    fn victim_step(&mut self, number: usize) -> (StepReply, Vec<u8>) {
        let robots = (HOME * N_ROBOTS) as u32..N_WORLDS * N_ROBOTS as u32;
        let request = step_request(self.leases[0], robots);
        let paths = [0, 1, 2, 3, 4, 5, 6, 7].map(|turn| ((number * 7 + turn * 5) % 4) as u8);
        let (body, mut payload) = (step_body(number as u64, &paths), Vec::new());
        let stepped = self
            .simulator
            .step(self.now, VICTIM, &request, &body, &mut payload);
        let Stepped::Reply(reply) = stepped else {
            panic!("the victim holds all robots of its world");
        };
        assert_eq!(Status::try_from(reply.status), Ok(Status::Ok));
        (reply, payload)
    }

    /// Sends a path for the victim's robot of the shared world, unless one waits.
    fn fly_shared(&mut self) {
        if self.shared_step.is_some() || self.mirror.is_over() {
            return;
        }
        let k = self.mirror.result().step;
        let path: Vec<u8> = (0..N_MOVES as u64)
            .map(|turn| ((k + turn) % 4) as u8)
            .collect();
        let request = step_request(self.leases[3], N_THEIRS..N_THEIRS + 1);
        let body = step_body(k, &path);
        let mut payload = Vec::new();
        let stepped = self
            .simulator
            .step(self.now, SHARER, &request, &body, &mut payload);
        match stepped {
            Stepped::Waits(ticket) => self.shared_step = Some((ticket, path)),
            Stepped::Reply(reply) => {
                assert_eq!(check_answer(&reply, &payload), Status::Ok);
                self.check_shared_step(Some(&path));
            }
        }
        self.check_shared();
    }

    /// Takes the answers to steps that waited, and checks that the shared world is as its own paths make it.
    fn check_shared(&mut self) {
        let (mut payload, mut waited) = (Vec::new(), Duration::ZERO);
        let before = self.mirror.result().step;
        while let Some((ticket, reply)) = self.simulator.next_answer(&mut payload) {
            let status = check_answer(&reply, &payload);
            if let Some((_, since)) = self.attackers_step.take_if(|(own, _)| *own == ticket) {
                waited = self.now - since;
                continue;
            }
            let (waiting, path) = self.shared_step.take().expect("somebody waits for it");
            assert_eq!((waiting, status), (ticket, Status::Ok));
            self.check_shared_step(Some(&path));
        }
        for world in self.simulator.take_moved() {
            assert_ne!(world, HOME, "the victim's world moved on its own");
        }
        self.check_shared_step(None);
        let now = self.mirror.result();
        let is_late = now.step > before && now.late & 2 != 0;
        assert!(
            !is_late || waited >= DEADLINE,
            "the victim was not waited for"
        );
    }

    /// Takes the step in the mirror that the shared world has taken, if any: with this path of the victim's, or none.
    fn check_shared_step(&mut self, path: Option<&[u8]>) {
        let episode = self.simulator.episode(SHARED);
        let episode = episode.expect("nobody but who holds both robots resets it");
        let result = episode.result();
        if result.step == self.mirror.result().step {
            assert_eq!(path, None, "the victim's path was answered, but not flown");
        } else {
            let stayed = result.hovered | result.late;
            assert_eq!(result.hovered & 2, 0, "the victim holds its robot");
            let flown = (stayed & 2 == 0).then(|| path_to_bytes(episode.robots()[1].path()));
            assert_eq!(flown.as_deref(), path, "not the victim's path");
            let mut moves = vec![Move::Up; N_ROBOTS * N_MOVES];
            let mut full = 0;
            for (index, robot) in episode.robots().iter().enumerate() {
                moves[index * N_MOVES..][..robot.path().len()].copy_from_slice(robot.path());
                full |= u64::from(robot.result().coverage == Coverage::Full as u32) << index;
            }
            let flown = Flown {
                moves: &moves,
                ready: !stayed & 3,
                full,
                hovered: result.hovered,
                late: result.late,
            };
            self.mirror.step(&self.simulator.spec().rules, &flown);
        }
        assert!(
            seen(episode) == seen(&self.mirror),
            "the shared world differs"
        );
    }
}

fn seen(episode: &Episode) -> WorldSeen {
    let robots = episode.robots().iter();
    let robots = robots.map(|robot| (*robot.result(), robot.frame().as_bytes().to_vec()));
    (*episode.result(), robots.collect())
}

/// Checks that an answer is whole, and a refusal empty.
fn check_answer(reply: &StepReply, payload: &[u8]) -> Status {
    assert_eq!(reply.version, VERSION);
    let parts = split_step_payload(reply, payload).expect("as long as its header says");
    let status = Status::try_from(reply.status).expect("a known status");
    assert_eq!(parts.worlds.is_empty(), status != Status::Ok, "{status:?}");
    status
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

fn step_request(lease: u64, robots: Range<u32>) -> StepRequest {
    StepRequest {
        version: VERSION,
        operation: Operation::Step as u32,
        lease,
        sequence: 7,
        first_robot: robots.start,
        n_robots: robots.len() as u32,
        n_moves: N_MOVES as u32,
        ..StepRequest::default()
    }
}

/// The payload of a step of one world.
fn step_body(k: u64, paths: &[u8]) -> Vec<u8> {
    let mut body = Vec::new();
    write_step_body(&[k], paths, &mut body);
    body
}

pub fn step_seeds() -> Vec<Seed> {
    // The attacker's lease is the third that is given.
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
    let mut of_both = Vec::new();
    write_step_body(&[0, 0], &[paths, paths].concat(), &mut of_both);
    vec![
        ("one_world", with(&one, &step_body(0, &paths))),
        ("two_worlds", with(&both, &of_both)),
        ("full_team_frame", with(&full, &step_body(0, &paths))),
        ("observe", with(&observe, &[])),
        ("recall", with(&recall, &step_body(0, &[]))),
        ("shared", with(&shared, &step_body(0, &[3; N_MOVES]))),
        ("stolen_lease", with(&victims, &step_body(0, &paths))),
    ]
}

pub fn control_seeds() -> Vec<Seed> {
    let texts = [
        (
            "hello",
            r#" {"op":"hello","protocol":2,"client":"fuzz 0.1"}"#,
        ),
        (
            "acquire",
            r#" {"op":"acquire","first_robot":0,"n_robots":5,"ttl_millis":100}"#,
        ),
        (
            "takeover",
            r#"#{"op":"acquire","first_robot":3,"n_robots":2,"takeover":true,"ttl_millis":null}"#,
        ),
        ("renew", r#"F{"op":"renew","lease":LEASE}"#),
        ("release", r#"B{"op":"release","lease":LEASE}"#),
        (
            "reset",
            r#""{"op":"reset","lease":LEASE,"worlds":[{"world":1,"seed":3},{"world":0}]}"#,
        ),
        ("reset_none", r#"${"op":"reset","lease":LEASE,"worlds":[]}"#),
        (
            "snapshot",
            r#"`{"op":"snapshot","first_world":0,"n_worlds":4,"path":"/a"}"#,
        ),
        (
            "restore",
            r#""{"op":"restore","lease":LEASE,"first_world":0,"n_worlds":2,"from":1,"path":"/a"}"#,
        ),
        ("fork", r#""{"op":"fork","lease":LEASE,"from":3,"to":1}"#),
        (
            "leave_belief",
            r#"B{"op":"leave_belief","lease":LEASE,"robot":0,"episode":0,"step":0,"kind":"k","offset":0,"length":2,"data":"AAE="}"#,
        ),
        ("belief", r#""{"op":"belief","robot":0,"offset":0}"#),
        ("status", r#"0{"op":"status"}"#),
        ("shutdown", r#" {"op":"shutdown"}"#),
    ];
    texts.map(|(name, text)| (name, text.into())).to_vec()
}
