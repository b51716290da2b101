//! Programs as children: started on names of their own, waited for with deadlines, killed on drop.

use env_server::config::ServerConfig;
use env_server::snapshot::{SnapshotWorld, WorldSpec, encode};
use env_server::world::Episode;
use protocol::channels::Instance;
use protocol::client::{Claim, Observation};
use protocol::connection::ConnectionError;
use protocol::control::{Reply, Request, ServerInfo, ServerStatus, WorldSeed};
use protocol::message::{FrameHeader, Operation, RobotResult, StepRequest, WorldResult};
use protocol::observer::{Observer, Sample};
use protocol::path::path_from_bytes;
use protocol::payload::{RobotSample, split_frame_payload};
use protocol::{Client, Connection, Move};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rustix::process::{Pid, Signal, kill_process};
use std::fs::File;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant, SystemTime};
use tempfile::TempDir;

/// How long anything may take that should take milliseconds: less than a lease lasts, 30 s.
pub const PATIENCE: Duration = Duration::from_secs(25);

/// How long a server that has just begun may take to answer, before it is asked again.
const START: Duration = Duration::from_secs(3);

/// A small, quick server: 5 x 7 cells, 6 moves, 20 steps of burn-in.
pub const SMALL: &str = "--height 5 --width 7 --moves 6 --burn-in 20";

/// A burn-in that never ends, steps.
pub const ENDLESS: u64 = 1 << 40;

/// A child process and what it wrote to its standard error so far.
pub struct Program {
    child: Child,
    folder: TempDir,
}

/// A world's last result, that of one of its robots, and what this robot saw.
pub type Seen = (WorldResult, RobotResult, Vec<u8>);

/// A running server; killed on drop.
pub struct Server {
    /// Its process.
    pub program: Program,
    /// Its instance.
    pub instance: Instance,
}

/// How a program ended.
#[derive(Debug)]
pub struct Ended {
    /// Its exit code; `None` if a signal ended it.
    pub code: Option<i32>,
    /// Its standard output.
    pub stdout: String,
    /// Its standard error.
    pub stderr: String,
}

impl Program {
    /// Starts a program of this workspace.
    pub fn start(name: &str, arguments: &[&str]) -> Self {
        Self::start_at(&program_path(name), arguments)
    }

    /// Starts Python with the package, for the lines of a script.
    pub fn start_python(script: &str) -> Self {
        Self::start_at(&python(), &["-c", script])
    }

    fn start_at(program: &Path, arguments: &[&str]) -> Self {
        let folder = TempDir::new().expect("a folder for the program's output");
        let file = |name: &str| File::create(folder.path().join(name)).expect("an output file");
        let child = Command::new(program)
            .args(arguments)
            .stdin(Stdio::null())
            .stdout(file("stdout"))
            .stderr(file("stderr"))
            .env("RUST_LOG", "info")
            .spawn();
        Self {
            child: child.expect("start the program"),
            folder,
        }
    }

    /// Its process id.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// What it has written to its standard error so far.
    pub fn stderr(&self) -> String {
        self.read("stderr")
    }

    /// Sends it a signal.
    pub fn signal(&self, signal: Signal) {
        let pid = Pid::from_raw(self.child.id() as i32).expect("a process id");
        kill_process(pid, signal).expect("signal the program");
    }

    /// Pauses it; returns when it no longer runs.
    pub fn stop(&self) {
        self.signal(Signal::STOP);
        let stat = format!("/proc/{}/stat", self.pid());
        let is_stopped = || {
            let stat = std::fs::read_to_string(&stat).expect("its state");
            stat.rsplit(") ")
                .next()
                .is_some_and(|rest| rest.starts_with('T'))
        };
        assert!(eventually(PATIENCE, is_stopped), "{}", self.stderr());
    }

    /// Whether it has ended.
    pub fn has_ended(&mut self) -> bool {
        let status = self.child.try_wait();
        status.expect("look at the program").is_some()
    }

    /// Waits until it ends.
    pub fn wait(mut self, limit: Duration) -> Ended {
        let mut status: Option<ExitStatus> = None;
        let ended = eventually(limit, || {
            status = self.child.try_wait().expect("wait for the program");
            status.is_some()
        });
        assert!(ended, "still running after {limit:?}: {}", self.stderr());
        Ended {
            code: status.and_then(|status| status.code()),
            stdout: self.read("stdout"),
            stderr: self.stderr(),
        }
    }

    /// Kills it as no handler can prevent, unless it has ended; returns when it is gone.
    pub fn kill(mut self) {
        self.child.kill().expect("kill the program");
        self.child.wait().expect("wait for the program");
    }

    /// Waits until its standard error says something.
    pub fn wait_for_words(&self, words: &str, limit: Duration) {
        let said = eventually(limit, || self.stderr().contains(words));
        assert!(said, "{words:?} not said in {limit:?}: {}", self.stderr());
    }

    fn read(&self, file: &str) -> String {
        std::fs::read_to_string(self.folder.path().join(file)).expect("read the output")
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Server {
    /// Starts a server on an instance of its own; `flags` are separated by spaces.
    pub fn start(flags: &str) -> Self {
        Self::start_on(&new_instance(), flags)
    }

    /// Starts a server on an instance and waits until its worlds are ready.
    pub fn start_on(instance: &Instance, flags: &str) -> Self {
        let arguments: Vec<&str> = flags.split_whitespace().collect();
        Self::start_with(instance, &arguments)
    }

    /// As [`Self::start_on`], with flags that may hold spaces.
    pub fn start_with(instance: &Instance, flags: &[&str]) -> Self {
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

    /// Starts a server on an instance; it may not answer yet.
    pub fn start_without_waiting(instance: &Instance, flags: &[&str]) -> Self {
        let arguments = [&["--instance", instance.name()], flags].concat();
        Self {
            program: Program::start("emberwatch-server", &arguments),
            instance: instance.clone(),
        }
    }

    /// Starts a server on an instance and waits until it answers; its worlds are in burn-in then.
    pub fn start_in_burn_in(instance: &Instance, flags: &str) -> Self {
        let flags: Vec<&str> = flags.split_whitespace().collect();
        let server = Self::start_without_waiting(instance, &flags);
        let answers = eventually(PATIENCE, || status_within(instance, START).is_ok());
        assert!(answers, "{}", server.program.stderr());
        server
    }

    /// Starts a server of two worlds as [`SMALL`] ones at k = 0, whose every reset goes on for ever.
    pub fn start_with_endless_resets(flags: &str) -> Self {
        let WorldSpec {
            settings,
            mut rules,
        } = small_spec(ENDLESS);
        rules.burn_in = 0;
        let episodes = [0, 1].map(|seed| Episode::new(&rules, seed));
        let worlds = episodes.each_ref().map(SnapshotWorld::Ready);
        let folder = TempDir::new().expect("a folder for the worlds");
        let file = folder.path().join("worlds.snapshot");
        std::fs::write(&file, encode(&settings, &worlds).expect("small")).expect("write");
        let shape = "--height 5 --width 7 --moves 6 --worlds 2";
        let file = file.display();
        Self::start(&format!(
            "{shape} --burn-in {ENDLESS} --restore {file} {flags}"
        ))
    }

    /// A new connection to it.
    pub fn connect(&self) -> Connection {
        Connection::open(&self.instance, "tests", PATIENCE).expect("connect")
    }

    /// A client that holds robots of it.
    pub fn acquire(&self, robots: Range<u32>) -> Client {
        Client::acquire(self.connect(), &Claim::new(robots)).expect("acquire")
    }

    /// What it answers to `hello`.
    pub fn info(&self) -> ServerInfo {
        self.connect().info().clone()
    }

    /// What it answers to `status`.
    pub fn status(&self) -> ServerStatus {
        status(&self.instance).expect("status")
    }

    /// What a robot shows, and its world's last result, over a connection that holds nothing.
    pub fn observe(&self, robot: u32) -> Seen {
        let request = StepRequest {
            operation: Operation::Observe as u32,
            first_robot: robot,
            n_robots: 1,
            ..StepRequest::default()
        };
        let answer = self
            .connect()
            .step(request, &[], PATIENCE)
            .expect("observe");
        (answer.worlds[0], answer.robots[0], answer.frames)
    }

    /// The step k that the world of a robot is at.
    pub fn step_of(&self, robot: u32) -> u64 {
        self.observe(robot).0.step
    }

    /// Kills it as no handler can prevent; returns when it is gone.
    pub fn kill(self) {
        self.program.kill();
    }
}

/// A claim on robots that are taken from their holders.
pub fn takeover(robots: Range<u32>) -> Claim {
    Claim {
        takeover: true,
        ..Claim::new(robots)
    }
}

/// Runs a program to its end.
pub fn run(name: &str, arguments: &[&str], limit: Duration) -> Ended {
    Program::start(name, arguments).wait(limit)
}

/// A name that no other test has.
pub fn new_instance() -> Instance {
    static COUNTER: AtomicU64 = AtomicU64::new(0);
    let count = COUNTER.fetch_add(1, Ordering::Relaxed);
    let name = format!("test-{}-{count}", std::process::id());
    Instance::new(&name).expect("a plain name")
}

/// Looks every millisecond until something holds; returns whether it did before the deadline.
pub fn eventually(limit: Duration, mut holds: impl FnMut() -> bool) -> bool {
    let deadline = Instant::now() + limit;
    while !holds() {
        if Instant::now() > deadline {
            return false;
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    true
}

/// What snapshots of a server as a [`SMALL`] one say of it, and the rules of its worlds.
pub fn small_spec(burn_in: u64) -> WorldSpec {
    let config = ServerConfig {
        height: 5,
        width: 7,
        moves: 6,
        burn_in,
        ..ServerConfig::default()
    };
    let checked = config.check().expect("valid settings");
    WorldSpec::of(&checked).expect("a valid model")
}

/// The server's status, over a connection of its own.
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

/// Reproducible paths.
pub struct Paths(ChaCha8Rng);

impl Paths {
    /// The paths of a seed.
    pub fn new(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    /// The next path.
    pub fn next(&mut self, n_moves: usize) -> Vec<Move> {
        let moves = (0..n_moves).map(|_| Move::from_low_bits(self.0.random()));
        moves.collect()
    }

    /// The next paths.
    pub fn take(&mut self, n_moves: usize, n_paths: usize) -> Vec<Vec<Move>> {
        (0..n_paths).map(|_| self.next(n_moves)).collect()
    }
}

/// Starts a client's worlds again with consecutive seeds.
pub fn reset(client: &mut Client, first_seed: u64) {
    let seeds: Vec<WorldSeed> = client
        .worlds_of(&client.robots())
        .zip(first_seed..)
        .map(|(world, seed)| WorldSeed {
            world,
            seed: Some(seed),
        })
        .collect();
    client.reset(&seeds).expect("reset");
}

/// Flies one path with a client's only robot.
pub fn fly(client: &mut Client, path: Vec<Move>) -> Observation {
    let robots = client.robots();
    client.step(robots, &[path]).expect("step").remove(0)
}

/// The robots of a published step.
pub fn robots_of(sample: &Sample<FrameHeader>) -> Vec<RobotSample<'_>> {
    split_frame_payload(&sample.header, &sample.payload).expect("a whole sample")
}

/// The path of the only robot of a published step; empty after a reset.
pub fn path_of(sample: &Sample<FrameHeader>) -> Vec<Move> {
    path_from_bytes(robots_of(sample)[0].path).expect("a path")
}

/// What the only robot of a published step shows, as [`Server::observe`] does.
pub fn seen_in(sample: &Sample<FrameHeader>) -> Seen {
    let robot = &robots_of(sample)[0];
    (sample.header.result, robot.result, robot.frame.to_vec())
}

/// What an answer of a client shows, as [`Server::observe`] does.
pub fn seen_by(observation: &Observation) -> Seen {
    let frame = observation.frame.as_bytes().to_vec();
    (observation.world, observation.robot, frame)
}

/// Reads frames until one of a world and step has come; returns all, that one last.
pub fn frames_until(
    observer: &Observer<FrameHeader>,
    world: u32,
    step: u64,
) -> Vec<Sample<FrameHeader>> {
    let mut samples = Vec::new();
    let deadline = Instant::now() + PATIENCE;
    loop {
        let left = deadline.saturating_duration_since(Instant::now());
        let sample = observer.receive(left).expect("receive");
        let sample = sample.unwrap_or_else(|| panic!("no frame of world {world} at step {step}"));
        let is_last = sample.header.world == world && sample.header.result.step == step;
        samples.push(sample);
        if is_last {
            return samples;
        }
    }
}

/// The root of the repository.
pub fn repository() -> PathBuf {
    let tests = Path::new(env!("CARGO_MANIFEST_DIR"));
    tests.parent().expect("tests lies in the repository").into()
}

/// The Python of the tests, which `scripts/test` makes.
pub fn python() -> PathBuf {
    let python = repository().join("target/venv/bin/python");
    assert!(python.exists(), "no {}; run scripts/test", python.display());
    python
}

/// The program of a name, as built from the present sources.
pub fn program_path(name: &str) -> PathBuf {
    let test = std::env::current_exe().expect("this program's path");
    let target = test.ancestors().nth(2).expect("target/<profile>/deps/test");
    let path = target.join(name);
    let package = match name {
        "emberwatch-server" => "env-server",
        "emberwatch-dashboard" => "clients/dashboard",
        _ => "agent",
    };
    let sources = [package, "protocol"].map(|package| repository().join(package).join("src"));
    let newest = sources
        .iter()
        .filter_map(|folder| newest_change(folder))
        .max();
    let built = path
        .metadata()
        .and_then(|metadata| metadata.modified())
        .ok();
    assert!(
        built.is_some() && built >= newest,
        "{name} is missing or older than its source: run `cargo build --workspace`, with the \
         profile of the tests, before them"
    );
    path
}

fn newest_change(path: &Path) -> Option<SystemTime> {
    if path.is_file() {
        return path
            .metadata()
            .and_then(|metadata| metadata.modified())
            .ok();
    }
    let entries = std::fs::read_dir(path).ok()?.flatten();
    entries
        .filter_map(|entry| newest_change(&entry.path()))
        .max()
}
