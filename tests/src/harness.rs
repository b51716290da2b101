//! Servers as child processes, each on its own instance, and helpers for tests with them.

use crate::wire::observe_header;
use emberwatch_protocol::backend::Backend;
use emberwatch_protocol::channels::{Instance, channel_directory};
use emberwatch_protocol::client::{Claim, Observation};
use emberwatch_protocol::connection::ConnectionError;
use emberwatch_protocol::control::{Reply, Request, ServerInfo, ServerStatus, WorldSeed};
use emberwatch_protocol::message::{FrameHeader, RobotResult, WorldResult};
use emberwatch_protocol::observer::{Observer, Sample};
use emberwatch_protocol::path::path_from_bytes;
use emberwatch_protocol::payload::{RobotSample, split_frame_payload, split_step_payload};
use emberwatch_protocol::{Client, Connection, Move};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use std::ops::Range;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

pub use crate::programs::{
    AGENT, Ended, Folder, LIMIT, PATIENCE, Program, SERVER, eventually, program_path, python,
    repository, run,
};

/// How long to wait for the answer of a starting server before the request is sent again.
const START: Duration = Duration::from_secs(3);

/// A small, quick server: 5 x 7 cells, 6 moves, 20 steps of burn-in.
pub const SMALL: &str = "--height 5 --width 7 --moves 6 --burn-in 20";

/// A number of burn-in steps so large that the burn-in never ends.
pub const ENDLESS: u64 = 1 << 40;

/// The latest result of a world, and the result and frame of one of its robots.
pub type AgentObservation = (WorldResult, RobotResult, Vec<u8>);

pub struct Server {
    pub program: Program,
    pub instance: Instance,
}

impl Server {
    /// Starts a server on a new instance; `flags` are separated by spaces.
    pub fn start(flags: &str) -> Self {
        Self::start_on(&new_instance(), flags)
    }

    /// Starts a server on an instance and waits until its worlds are ready.
    pub fn start_on(instance: &Instance, flags: &str) -> Self {
        let server = Self::start_without_waiting(instance, flags);
        let mut problem = String::new();
        let answers = eventually(2 * PATIENCE, || match status_within(instance, START) {
            Ok(status) => !status.worlds.iter().any(|world| world.resetting),
            Err(error) => {
                problem = error.to_string();
                false
            }
        });
        assert!(answers, "{problem}: {}", server.program.stderr());
        server
    }

    /// Starts a server on an instance and returns immediately, when the server may not answer yet.
    pub fn start_without_waiting(instance: &Instance, flags: &str) -> Self {
        let arguments = format!("--instance {} {flags}", instance.name());
        Self {
            program: Program::start(SERVER, &arguments),
            instance: instance.clone(),
        }
    }

    pub fn connect(&self) -> Connection {
        Connection::open(&self.instance, "tests", PATIENCE).expect("connect")
    }

    /// Creates a client that holds robots of this server.
    pub fn acquire(&self, robots: Range<u32>) -> Client {
        Client::acquire(self.connect(), &Claim::new(robots)).expect("acquire")
    }

    /// Creates a client that takes over robots of this server.
    pub fn take_over(&self, robots: Range<u32>) -> Client {
        Client::acquire(self.connect(), &takeover(robots)).expect("take over")
    }

    /// Returns the flag that names this instance.
    pub fn flag(&self) -> String {
        format!("--instance {}", self.instance.name())
    }

    pub fn info(&self) -> ServerInfo {
        self.connect().info().clone()
    }

    pub fn status(&self) -> ServerStatus {
        status(&self.instance).expect("status")
    }

    /// Observes a robot and its world over a connection without a lease.
    pub fn observe(&self, robot: u32) -> AgentObservation {
        let request = observe_header(robot..robot + 1);
        let answer = self.connect().step(request, &[], PATIENCE);
        let (reply, payload) = answer.expect("observe");
        let parts = split_step_payload(&reply, &payload).expect("a payload as checked");
        (parts.worlds[0], parts.robots[0], parts.frames.to_vec())
    }

    /// Returns the current step k of a robot's world.
    pub fn step_of(&self, robot: u32) -> u64 {
        self.observe(robot).0.step
    }

    pub fn holder(&self) -> Option<u32> {
        self.status().worlds[0].holder_pids[0]
    }

    /// Runs a subcommand of the server program on this instance.
    pub fn command(&self, words: &str) -> Ended {
        run(SERVER, &format!("{words} {}", self.flag()))
    }

    /// Kills the server with SIGKILL and waits until it has ended.
    pub fn kill(self) {
        self.program.kill();
    }
}

/// Returns the claim for a lease that takes robots over from their holders.
pub fn takeover(robots: Range<u32>) -> Claim {
    Claim {
        takeover: true,
        ..Claim::new(robots)
    }
}

/// Returns the seed of one world for a reset request. If `seed` is `None`, the server chooses it.
pub fn seed(world: u32, seed: impl Into<Option<u64>>) -> WorldSeed {
    WorldSeed {
        world,
        seed: seed.into(),
    }
}

/// Returns an instance name that no other test uses.
pub fn new_instance() -> Instance {
    static COUNTER: AtomicU64 = AtomicU64::new(0);
    let count = COUNTER.fetch_add(1, Ordering::Relaxed);
    let name = format!("test-{}-{count}", std::process::id());
    Instance::new(&name).expect("a plain name")
}

/// Returns the files of an instance's services.
pub fn service_files(instance: &Instance) -> Vec<PathBuf> {
    let files = std::fs::read_dir(channel_directory().join("services"));
    let files = files.expect("services").flatten().map(|entry| entry.path());
    let name = format!("emberwatch/v3/{}/", instance.name());
    let text = |path: &PathBuf| std::fs::read_to_string(path).unwrap_or_default();
    files.filter(|path| text(path).contains(&name)).collect()
}

/// Asks for the server's status over a new connection.
pub fn status(instance: &Instance) -> Result<ServerStatus, ConnectionError> {
    status_within(instance, PATIENCE)
}

fn status_within(instance: &Instance, limit: Duration) -> Result<ServerStatus, ConnectionError> {
    let mut connection = Connection::open(instance, "tests", limit)?;
    match connection.control(&Request::Status {}, limit)? {
        Reply::Status(status) => Ok(status),
        other => panic!("expected a status, got {other:?}"),
    }
}

/// A generator of reproducible random paths.
pub struct Paths(ChaCha8Rng);

impl Paths {
    pub fn new(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    pub fn next(&mut self, n_moves: usize) -> Vec<Move> {
        let moves = (0..n_moves).map(|_| Move::from_low_bits(self.0.random()));
        moves.collect()
    }

    pub fn take(&mut self, n_moves: usize, n_paths: usize) -> Vec<Vec<Move>> {
        (0..n_paths).map(|_| self.next(n_moves)).collect()
    }
}

/// Resets a client's worlds to consecutive seeds.
pub fn reset(client: &mut Client, first_seed: u64) {
    let worlds = client.worlds_of(&client.robots());
    let seeds = worlds.zip(first_seed..);
    let seeds: Vec<WorldSeed> = seeds.map(|(world, to)| seed(world, to)).collect();
    client.reset(&seeds).expect("reset");
}

/// Flies one path with a client's only robot.
pub fn send_paths(client: &mut Client, path: Vec<Move>) -> Observation {
    let robots = client.robots();
    client.step(robots, &[path]).expect("step").remove(0)
}

/// Flies `n_steps` random paths with a client's only robot.
pub fn fly_on(client: &mut Client, seed: u64, n_steps: usize) -> Vec<Observation> {
    let paths = Paths::new(seed)
        .take(client.info().n_moves, n_steps)
        .into_iter();
    paths.map(|path| send_paths(client, path)).collect()
}

/// Returns the robots of a published step.
pub fn robots_of(sample: &Sample<FrameHeader>) -> Vec<RobotSample<'_>> {
    split_frame_payload(&sample.header, &sample.payload).expect("a whole sample")
}

/// Returns the path of the only robot of a published step. Empty after a reset.
pub fn path_of(sample: &Sample<FrameHeader>) -> Vec<Move> {
    path_from_bytes(robots_of(sample)[0].path).expect("a path")
}

/// Converts a published step with one robot to the form that [`Server::observe`] returns.
pub fn seen_in(sample: &Sample<FrameHeader>) -> AgentObservation {
    let robot = &robots_of(sample)[0];
    (sample.header.result, robot.result, robot.frame.to_vec())
}

/// Converts a client's observation to the form that [`Server::observe`] returns.
pub fn seen_by(observation: &Observation) -> AgentObservation {
    let frame = observation.frame.as_bytes().to_vec();
    (observation.world, observation.robot, frame)
}

/// Reads frames until the frame of this world and step arrives. Returns all frames read.
pub fn frames_until(
    observer: &Observer<FrameHeader>,
    world: u32,
    step: u64,
) -> Vec<Sample<FrameHeader>> {
    let mut samples = Vec::new();
    let deadline = Instant::now() + PATIENCE;
    loop {
        let left = deadline.saturating_duration_since(Instant::now());
        let sample = observer
            .receive(left)
            .expect("receive")
            .unwrap_or_else(|| panic!("no frame of world {world} at step {step}"));
        let is_last = sample.header.world == world && sample.header.result.step == step;
        samples.push(sample);
        if is_last {
            return samples;
        }
    }
}
