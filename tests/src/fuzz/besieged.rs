//! A simulator under attack, with a victim that acts on its own world and shares another world with an attacker.
//!
//! Successive inputs go to the same simulator, so that leases, resets and episodes reach every state. After some inputs
//! a new simulator replaces it, so that a failure can be reproduced from few inputs.

use crate::mirror::step_again;
use crate::wire::{step_body, step_header};
use emberwatch_protocol::control::{CoverageRule, Reply, WorldStatus};
use emberwatch_protocol::message::{
    RobotResult, Status, StepReply, StepRequest, VERSION, WorldResult,
};
use emberwatch_protocol::path::path_to_bytes;
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
use std::sync::OnceLock;
use std::time::{Duration, Instant};

pub const N_MOVES: usize = 4;
pub const N_ROBOTS: usize = 2;
/// Number of worlds: two worlds of the attackers, the shared world and the victim's world.
pub const N_WORLDS: u32 = 4;
/// The shared world. The attacker holds its first robot, and the victim its second robot.
pub const SHARED: usize = 2;
/// The victim's world.
const HOME: usize = 3;
/// Number of robots that the attackers hold, from robot 0 on.
pub const N_THEIRS: u32 = (SHARED * N_ROBOTS + 1) as u32;

/// Deadline of the shared world.
const DEADLINE: Duration = Duration::from_millis(50);

/// Number of inputs after which the simulator is replaced.
const N_INPUTS: usize = 256;

/// Number of inputs from one step of the victim to the next.
const VICTIM_STEPS: usize = 8;

/// The victim's two clients, which must not be disturbed: one in its own world, the other in the shared world.
const VICTIM: ClientId = ClientId { node: 1, pid: 1 };
const SHARER: ClientId = ClientId { node: 4, pid: 4 };

/// The attacking clients. The first one holds the attackers' robots.
pub const ATTACKERS: [ClientId; 2] = [ClientId { node: 2, pid: 2 }, ClientId { node: 3, pid: 3 }];

/// A simulator under attack, with the simulated clock and the requests that wait.
pub struct Siege {
    pub simulator: Simulator,
    pub now: Instant,
    pub jobs: Vec<ResetJob>,
    pub pending: Vec<(ClientId, PendingReply)>,
    /// The leases, in this order: the victim's in its own world, the latest two of the attackers, the victim's in the
    /// shared world.
    pub leases: [u64; 4],
    /// The attacker's step request that waits, and the time at which it was sent.
    pub attackers_step: Option<(Ticket, Instant)>,
    /// The victim's step request that waits in the shared world, and its path.
    shared_step: Option<(Ticket, Vec<u8>)>,
    /// The expected state of the shared world.
    mirror: Episode,
    n_inputs: usize,
}

/// The result of a world, and the result and frame of each of its robots.
pub type WorldSeen = (WorldResult, Vec<(RobotResult, Vec<u8>)>);

pub fn on_siege(input: impl FnOnce(&mut Siege) -> bool) -> bool {
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
    /// Creates the simulator, in which the victim and the first attacker hold their robots.
    fn begin() -> Self {
        let config = ServerConfig {
            worlds: N_WORLDS,
            deadline_millis: DEADLINE.as_millis() as u64,
            coverage: CoverageRule::Client,
            world: WorldSettings {
                robots: N_ROBOTS as u32,
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
        let mirror = Episode::new(&simulator.spec().rules, SHARED as u64);
        let mut siege = Self {
            simulator,
            now: Instant::now(),
            jobs,
            pending: Vec::new(),
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
            let robots = format!(r#""first_robot":{first_robot},"n_robots":{n_robots}"#);
            let text = format!(r#"{{"op":"acquire",{robots},"ttl_millis":86400000}}"#);
            let Outcome::Pending(_, pending) = siege.ask(client, VERSION, text.as_bytes()) else {
                panic!("the robots are free");
            };
            siege.answer(who, &pending);
        }
        siege
    }

    pub fn ask(&mut self, client: ClientId, version: u32, text: &[u8]) -> Outcome {
        self.simulator
            .control(self.now, client, version, text, &ServerStats::default())
    }

    /// Runs the pending resets and answers the clients that waited for them.
    pub fn finish_resets(&mut self) {
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
    pub fn worlds(&self) -> Vec<Option<WorldSeen>> {
        let worlds = self.simulator.worlds();
        let episodes = worlds.map(|world| self.simulator.episode(world));
        episodes.map(|episode| episode.map(seen)).collect()
    }

    /// Returns the public status of the worlds.
    pub fn status(&mut self) -> Vec<WorldStatus> {
        match self.ask(VICTIM, VERSION, br#"{"op":"status"}"#) {
            Outcome::Answer(Reply::Status(status)) => status.worlds,
            _ => panic!("everybody may ask for the status"),
        }
    }

    /// Steps the victim's world and checks that it evolves as if there were no attacker. Then sends or cancels a step
    /// in the shared world.
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
            // A path whose request was cancelled must never be flown.
            Some((ticket, _)) => self.simulator.cancel_step(self.now, ticket),
            None => self.fly_shared(),
        }
    }

    fn victim_step(&mut self, number: usize) -> (StepReply, Vec<u8>) {
        let robots = (HOME * N_ROBOTS) as u32..N_WORLDS * N_ROBOTS as u32;
        let request = step_request(self.leases[0], robots);
        let paths = [0, 1, 2, 3, 4, 5, 6, 7].map(|turn| ((number * 7 + turn * 5) % 4) as u8);
        let (body, mut payload) = (step_body(&[number as u64], &paths), Vec::new());
        let simulator = &mut self.simulator;
        let stepped = simulator.step(self.now, VICTIM, &request, &body, &mut payload);
        let Stepped::Reply(reply) = stepped else {
            panic!("the victim holds all robots of its world");
        };
        assert_eq!(reply.status, Status::Ok as u32);
        (reply, payload)
    }

    /// Sends a path for the victim's robot in the shared world, unless such a request is already waiting.
    pub fn fly_shared(&mut self) {
        if self.shared_step.is_some() || self.mirror.is_over() {
            return;
        }
        let k = self.mirror.outcome().step;
        let path: Vec<u8> = (0..N_MOVES as u64)
            .map(|turn| ((k + turn) % 4) as u8)
            .collect();
        let request = step_request(self.leases[3], N_THEIRS..N_THEIRS + 1);
        let body = step_body(&[k], &path);
        let (simulator, mut payload) = (&mut self.simulator, Vec::new());
        match simulator.step(self.now, SHARER, &request, &body, &mut payload) {
            Stepped::Waits(ticket) => self.shared_step = Some((ticket, path)),
            Stepped::Reply(reply) => {
                assert_eq!(check_answer(&reply, &payload), Status::Ok);
                self.check_shared_step(Some(&path));
            }
        }
        self.check_shared();
    }

    /// Collects the answers to waiting step requests, and checks that the shared world has moved as its paths imply.
    pub fn check_shared(&mut self) {
        let (mut payload, mut waited) = (Vec::new(), Duration::ZERO);
        let before = self.mirror.outcome().step;
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
        let now = self.mirror.outcome();
        let is_late = now.step > before && now.late & 2 != 0;
        let is_due = !is_late || waited >= DEADLINE;
        assert!(is_due, "the victim was not waited for");
    }

    /// If the shared world has stepped, repeats the step in the mirror. `path` is the victim's path if its request was
    /// answered.
    fn check_shared_step(&mut self, path: Option<&[u8]>) {
        let episode = self.simulator.episode(SHARED);
        let episode = episode.expect("only a client that holds both robots can reset it");
        let result = world_result(episode.outcome());
        if result.step == self.mirror.outcome().step {
            assert_eq!(path, None, "the victim's path was answered, but not flown");
        } else {
            let stayed = result.hovered | result.late;
            assert_eq!(result.hovered & 2, 0, "the victim holds its robot");
            let flown = (stayed & 2 == 0).then(|| path_to_bytes(episode.robots()[1].path()));
            assert_eq!(flown.as_deref(), path, "the flown path is not the victim's");
            let robots = episode.robots().iter();
            let robots = robots.map(|robot| (robot.path().to_vec(), robot_result(robot.outcome())));
            let rules = &self.simulator.spec().rules;
            step_again(&mut self.mirror, rules, &result, robots);
        }
        assert!(
            seen(episode) == seen(&self.mirror),
            "the shared world differs"
        );
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
pub fn check_answer(reply: &StepReply, payload: &[u8]) -> Status {
    assert_eq!(reply.version, VERSION);
    let parts = split_step_payload(reply, payload).expect("as long as its header says");
    let status = Status::try_from(reply.status).expect("a known status");
    assert_eq!(parts.worlds.is_empty(), status != Status::Ok, "{status:?}");
    status
}

pub fn step_request(lease: u64, robots: Range<u32>) -> StepRequest {
    StepRequest {
        sequence: 7,
        first_robot: robots.start,
        n_robots: robots.len() as u32,
        ..step_header(lease, N_MOVES as u32)
    }
}
