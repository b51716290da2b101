//! Round trip of a step from a Rust client to a server process and back:
//! `cargo bench -p tests --bench round_trip`; arguments after `--` go to the server.
//!
//! Prints median and tail in microseconds with the simulation's own time subtracted, on a machine
//! as it is and with three busy processes on top; then the processor time of an idle server. The peer
//! to hold this against, Gymnasium's AsyncVectorEnv, is measured by `scripts/bench` in the same run.

use protocol::Connection;
use protocol::channels::Instance;
use protocol::control::{Reply, Request};
use protocol::message::{Operation, StepRequest};
use protocol::payload::write_step_body;
use std::process::{Child, Command};
use std::sync::Barrier;
use std::time::{Duration, Instant};

const TIMEOUT: Duration = Duration::from_secs(20);
const N_STEPS: usize = 50_000;

/// A child process that is killed when it goes out of scope.
struct Running(Child);

impl Running {
    fn start(program: &str, arguments: &[&str]) -> Self {
        let child = Command::new(program)
            .args(arguments)
            .env("RUST_LOG", "warn")
            .spawn();
        Self(child.unwrap_or_else(|error| panic!("start {program}: {error}")))
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A connection with a lease on some robots, and the request and paths of their step.
struct Stepper {
    connection: Connection,
    request: StepRequest,
    paths: Vec<u8>,
    /// The step of each world.
    steps: Vec<u64>,
    body: Vec<u8>,
}

impl Stepper {
    fn new(instance: &Instance, first_robot: u32, n_robots: u32) -> Self {
        let mut connection = connect(instance);
        let acquire = Request::Acquire {
            first_robot,
            n_robots,
            takeover: true,
            ttl_millis: None,
        };
        let lease = match connection.control(&acquire, TIMEOUT) {
            Ok(Reply::Lease(lease)) => lease,
            other => panic!("acquire: {other:?}"),
        };
        let n_moves = connection.info().n_moves;
        let operation = Operation::Step as u32;
        let request = StepRequest {
            operation,
            lease: lease.lease,
            first_robot,
            n_robots,
            n_moves: n_moves as u32,
            ..StepRequest::default()
        };
        let paths = (0..n_moves * n_robots as usize)
            .map(|at| (at * 7 % 4) as u8)
            .collect();
        Self {
            connection,
            request,
            paths,
            steps: lease.worlds.iter().map(|world| world.step).collect(),
            body: Vec::new(),
        }
    }

    /// Nanoseconds of one round trip: all of it, and the simulation's share.
    fn step(&mut self) -> (u64, u64) {
        let start = Instant::now();
        self.body.clear();
        write_step_body(&self.steps, &self.paths, &mut self.body);
        let answer = self
            .connection
            .step(self.request, &self.body, TIMEOUT)
            .expect("a step");
        let total = start.elapsed().as_nanos() as u64;
        self.steps.iter_mut().for_each(|step| *step += 1);
        (total, answer.reply.simulation_nanos.min(total))
    }

    fn report(&mut self, what: &str, n_steps: usize) {
        (0..n_steps / 10).for_each(|_| _ = self.step());
        let start = Instant::now();
        let times: Vec<(u64, u64)> = (0..n_steps).map(|_| self.step()).collect();
        let per_second = n_steps as f64 * self.steps.len() as f64 / start.elapsed().as_secs_f64();
        let wire = Spread::of(times.iter().map(|(total, simulation)| total - simulation));
        let simulation = Spread::of(times.iter().map(|(_, simulation)| *simulation));
        say(&format!(
            "{what:<34} wire {wire}   simulation {simulation}   {per_second:>9.0} env-steps/s"
        ));
    }
}

/// Median, 99th and 99.9th percentile in microseconds.
struct Spread([f64; 3]);

impl Spread {
    fn of(nanos: impl Iterator<Item = u64>) -> Self {
        let mut nanos: Vec<u64> = nanos.collect();
        nanos.sort_unstable();
        let quantile = |q: f64| nanos[(nanos.len() as f64 * q) as usize] as f64 / 1000.0;
        Self([quantile(0.5), quantile(0.99), quantile(0.999)])
    }
}

impl std::fmt::Display for Spread {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "p50 {:7.2} p99 {:7.2} p99.9 {:8.2} us",
            self.0[0], self.0[1], self.0[2]
        )
    }
}

fn main() {
    let server = beside_this_program("emberwatch-server");
    // cargo adds `--bench` on its own.
    let more: Vec<String> = std::env::args()
        .skip(1)
        .filter(|argument| argument != "--bench")
        .collect();
    for (n_worlds, team) in [(1_u32, 1_u32), (64, 1), (1, 8)] {
        let name = format!("bench-{}-{n_worlds}-{team}", std::process::id());
        let (worlds, robots) = (n_worlds.to_string(), team.to_string());
        let mut arguments = vec!["--instance", &name, "--worlds", &worlds];
        arguments.extend(["--robots", &robots, "--burn-in", "1000"]);
        arguments.extend(more.iter().map(String::as_str));
        let running = Running::start(&server, &arguments);
        let instance = Instance::new(&name).expect("a plain name");
        let n_steps = N_STEPS / n_worlds.isqrt() as usize;
        let what = match team {
            1 => format!("{n_worlds} world(s)"),
            _ => format!("{team} robots of 1 client"),
        };
        let mut stepper = Stepper::new(&instance, 0, n_worlds * team);
        stepper.report(&format!("{what}, as the machine is"), n_steps);
        {
            let busy = ["-c", "while :; do :; done"];
            let _busy: Vec<Running> = (0..3).map(|_| Running::start("sh", &busy)).collect();
            stepper.report(&format!("{what}, 3 busy processes"), n_steps / 10);
        }
        drop(stepper);
        if team > 1 {
            report_barrier(&instance, team, n_steps / 10);
        }
        report_idleness(&running);
    }
}

/// Steps of one world whose robots have a client each.
fn report_barrier(instance: &Instance, team: u32, n_steps: usize) {
    let all_hold_one = Barrier::new(team as usize);
    std::thread::scope(|scope| {
        for robot in 1..team {
            let all_hold_one = &all_hold_one;
            scope.spawn(move || {
                let mut stepper = Stepper::new(instance, robot, 1);
                all_hold_one.wait();
                (0..n_steps + n_steps / 10).for_each(|_| _ = stepper.step());
            });
        }
        let mut stepper = Stepper::new(instance, 0, 1);
        all_hold_one.wait();
        stepper.report(&format!("{team} robots of {team} clients"), n_steps);
    });
}

fn report_idleness(server: &Running) {
    let (pid, pause) = (server.0.id(), Duration::from_secs(5));
    let before = processor_millis(pid);
    std::thread::sleep(pause);
    let share = (processor_millis(pid) - before) / pause.as_millis() as f64 * 100.0;
    say(&format!(
        "idle server: {share:.2} % of one core over {pause:?}"
    ));
}

/// User and system time of a process, from its `stat` file, in which the kernel counts 1/100 s.
fn processor_millis(pid: u32) -> f64 {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).expect("a running process");
    let after_name = stat
        .rsplit(')')
        .next()
        .expect("stat names the program in brackets");
    let fields: Vec<&str> = after_name.split_whitespace().collect();
    let ticks = |at: usize| fields[at].parse::<f64>().expect("stat holds numbers");
    (ticks(11) + ticks(12)) * 10.0
}

fn connect(instance: &Instance) -> Connection {
    let deadline = Instant::now() + TIMEOUT;
    loop {
        match Connection::open(instance, "round_trip", TIMEOUT) {
            Ok(connection) => return connection,
            Err(error) if Instant::now() > deadline => panic!("no server: {error}"),
            Err(_) => std::thread::sleep(Duration::from_millis(10)),
        }
    }
}

fn beside_this_program(name: &str) -> String {
    let program = std::env::current_exe().expect("this program has a path");
    let directory = program
        .ancestors()
        .nth(2)
        .expect("target/release/deps/round_trip");
    let path = directory.join(name);
    assert!(
        path.exists(),
        "expected {}: build it with `cargo build --release`",
        path.display()
    );
    path.display().to_string()
}

#[expect(clippy::print_stdout, reason = "a benchmark's output")]
fn say(line: &str) {
    println!("{line}");
}
