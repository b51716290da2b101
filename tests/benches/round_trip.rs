//! Measures the round trip of a step from a Rust client to a server process and back. Run it with `cargo bench -p tests
//! --bench round_trip`; arguments after `--` are passed to the server.
//!
//! Prints the median and tail latency in microseconds, excluding the time of the simulation. Measures first on the
//! machine as it is, then with three additional busy processes. Then prints the processor time of an idle server.
//! `scripts/bench` measures Gymnasium's AsyncVectorEnv in the same run for comparison.

use emberwatch_protocol::Client;
use std::io::Write;
use std::ops::Range;
use std::sync::Barrier;
use std::time::{Duration, Instant};
use tests::harness::{Program, Server};
use tests::meter::processor_seconds;

const N_STEPS: usize = 50_000;

/// A client whose robots fly the same paths in every step.
struct Flight {
    client: Client,
    paths: Vec<u8>,
}

impl Flight {
    fn new(server: &Server, robots: Range<u32>) -> Self {
        let client = server.take_over(robots.clone());
        let n_moves = client.info().n_moves * robots.len();
        let paths = (0..n_moves).map(|at| (at * 7 % 4) as u8).collect();
        Self { client, paths }
    }

    /// Returns the duration of one round trip and the part of it spent in the simulation, in nanoseconds.
    fn step(&mut self) -> (u64, u64) {
        let (start, robots) = (Instant::now(), self.client.robots());
        let answer = self.client.step_bytes(&robots, &self.paths);
        let total = start.elapsed().as_nanos() as u64;
        (total, answer.expect("a step").0.simulation_nanos.min(total))
    }

    fn report(&mut self, what: &str, n_steps: usize) {
        (0..n_steps / 10).for_each(|_| _ = self.step());
        let start = Instant::now();
        let times: Vec<(u64, u64)> = (0..n_steps).map(|_| self.step()).collect();
        let n_worlds = self.client.worlds_of(&self.client.robots()).len();
        let per_second = (n_steps * n_worlds) as f64 / start.elapsed().as_secs_f64();
        let wire = spread(times.iter().map(|(total, simulation)| total - simulation));
        let simulation = spread(times.iter().map(|(_, simulation)| *simulation));
        say(&format!(
            "{what:<34} wire {wire}   simulation {simulation}   {per_second:>9.0} env-steps/s"
        ));
    }
}

/// Formats the median, 99th and 99.9th percentile in microseconds.
fn spread(nanos: impl Iterator<Item = u64>) -> String {
    let micros = nanos.map(|nanos| nanos as f64 / 1000.0).collect();
    let [median, high, highest] = quantiles(micros, [0.5, 0.99, 0.999]);
    format!("p50 {median:7.2} p99 {high:7.2} p99.9 {highest:8.2} us")
}

fn main() {
    // Drops `--bench`, which Cargo itself adds.
    let more = std::env::args()
        .skip(1)
        .filter(|argument| argument != "--bench")
        .collect::<Vec<String>>()
        .join(" ");
    for (n_worlds, team) in [(1_u32, 1_u32), (64, 1), (1, 8)] {
        let server = Server::start(&format!(
            "--worlds {n_worlds} --robots {team} --burn-in 1000 {more}"
        ));
        let n_steps = N_STEPS / n_worlds.isqrt() as usize;
        let what = match team {
            1 => format!("{n_worlds} world(s)"),
            _ => format!("{team} robots of 1 client"),
        };
        let mut flight = Flight::new(&server, 0..n_worlds * team);
        flight.report(&format!("{what}, as the machine is"), n_steps);
        {
            let busy = ["-c", "while :; do :; done"];
            let start = |_| Program::start_at("sh".as_ref(), &busy);
            let _busy: Vec<Program> = (0..3).map(start).collect();
            flight.report(&format!("{what}, 3 busy processes"), n_steps / 10);
        }
        drop(flight);
        if team > 1 {
            report_barrier(&server, team, n_steps / 10);
        }
        report_idleness(server.program.pid());
    }
}

/// Measures steps of one world in which each robot has its own client.
fn report_barrier(server: &Server, team: u32, n_steps: usize) {
    let all_hold_one = Barrier::new(team as usize);
    std::thread::scope(|scope| {
        for robot in 1..team {
            let all_hold_one = &all_hold_one;
            scope.spawn(move || {
                let mut flight = Flight::new(server, robot..robot + 1);
                all_hold_one.wait();
                (0..n_steps + n_steps / 10).for_each(|_| _ = flight.step());
            });
        }
        let mut flight = Flight::new(server, 0..1);
        all_hold_one.wait();
        flight.report(&format!("{team} robots of {team} clients"), n_steps);
    });
}

fn report_idleness(pid: u32) {
    let pause = Duration::from_secs(5);
    let before = processor_seconds(pid);
    std::thread::sleep(pause);
    let share = (processor_seconds(pid) - before) / pause.as_secs_f64() * 100.0;
    say(&format!(
        "idle server: {share:.2} % of one core over {pause:?}"
    ));
}

fn say(line: &str) {
    let _ = writeln!(std::io::stdout(), "{line}");
}

/// Returns quantiles of values: 0.5 is the median, 1.0 the maximum.
fn quantiles<const N: usize>(mut numbers: Vec<f64>, shares: [f64; N]) -> [f64; N] {
    numbers.sort_unstable_by(f64::total_cmp);
    let last = numbers.len() - 1;
    shares.map(|share| numbers[last.min((numbers.len() as f64 * share) as usize)])
}
