//! Measures the time of a step with 0, 1, 4 and 16 observers. One of the observers is stopped.

use emberwatch_protocol::Probabilities;
use emberwatch_protocol::agent_belief::{BeliefPublisher, Intent};
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::message::AgentHeader;
use emberwatch_protocol::observer::Observer;
use emberwatch_protocol::path::path_to_bytes;
use emberwatch_protocol::payload::split_step_payload;
use rustix::process::Signal;
use std::time::{Duration, Instant};
use tests::harness::{Paths, Program, Server};
use tests::report::{quantiles, range, say};
use tests::stepper::Stepper;

const N_STEPS: usize = 20_000;

/// Measures a step for each number of observers in `n_rounds` rounds. Prints the server's time and the round trip.
pub fn compare(n_rounds: usize) {
    let audiences = [0, 1, 4, 16].map(|n_observers| {
        let attend = move |server: &Server| -> Vec<Program> {
            (0..n_observers).map(|n| start(server, n == 1)).collect()
        };
        (format!("{n_observers} observers"), attend)
    });
    table(n_rounds, "--burn-in 1000", &audiences);
}

/// Prints, for each audience (a set of observers or dashboards), the median and 99th percentile of the server's time
/// and of the round trip. For each of these quantiles, prints the median, minimum and maximum over the rounds.
pub fn table<A, T>(n_rounds: usize, flags: &str, audiences: &[(String, A)])
where
    A: Fn(&Server) -> T,
{
    say(&format!(
        "{:<28}{:>20}{:>20}{:>24}{:>24}",
        "us: median (least-most)", "server p50", "p99", "round trip p50", "p99"
    ));
    let mut rounds = vec![Vec::new(); audiences.len()];
    for _ in 0..n_rounds {
        for ((_, attend), times) in audiences.iter().zip(&mut rounds) {
            times.push(measure(flags, attend));
        }
    }
    for ((name, _), times) in audiences.iter().zip(&rounds) {
        let column = |index: usize| range(times.iter().map(|times| times[index]).collect(), 1);
        let [a, b, c, d] = [0, 1, 2, 3].map(column);
        say(&format!("{name:<28}{a:>20}{b:>20}{c:>24}{d:>24}"));
    }
}

/// Returns the median and 99th percentile of the server's time for a step, then of the round trip, in microseconds.
fn measure<T>(flags: &str, attend: impl Fn(&Server) -> T) -> [f64; 4] {
    let server = Server::start(flags);
    let _audience = attend(&server);
    let mut stepper = Stepper::new(server.connect(), 0..1);
    let info = stepper.connection.info().clone();
    let belief = Probabilities::from_elem((3, info.height, info.width), 1.0 / 3.0);
    let mut showcase = BeliefPublisher::open(&server.instance, 4 * belief.len() + 1024)
        .expect("the agent channel");
    let mut paths = Paths::new(0);
    let (mut work, mut trips) = (Vec::new(), Vec::new());
    let mut last = Instant::now();
    for n in 0..N_STEPS {
        let path = path_to_bytes(&paths.next(info.n_moves));
        // Limits the rate to 2,000 steps per second, because an agent's planning also limits its rate.
        while last.elapsed() < Duration::from_micros(500) {
            std::hint::spin_loop();
        }
        last = Instant::now();
        let (reply, payload) = stepper.step(&path);
        if n > N_STEPS / 10 {
            work.push(reply.simulation_nanos as f64 / 1e3);
            trips.push(last.elapsed().as_secs_f64() * 1e6);
        }
        // Publishes a belief at most every 20 ms, as agents do.
        if n % 40 == 0 && showcase.is_watched() {
            let parts = split_step_payload(&reply, &payload).expect("a good answer");
            let world = &parts.worlds[0];
            let about = AgentHeader {
                step: world.step,
                seed: world.seed,
                episode: world.episode,
                n_robots: 1,
                ..AgentHeader::default()
            };
            let shown = showcase.show(about, &belief, &Intent::default());
            shown.expect("a belief is shown");
        }
    }
    let [work, slow_work] = quantiles(work, [0.5, 0.99]);
    let [trip, slow_trip] = quantiles(trips, [0.5, 0.99]);
    [work, slow_work, trip, slow_trip]
}

fn start(server: &Server, is_stopped: bool) -> Program {
    let program = std::env::current_exe().expect("this program");
    let before = server.status().n_observers;
    let observer = Program::start_at(&program, &["observe", server.instance.name()]);
    observer.until(|| server.status().n_observers > before);
    if is_stopped {
        observer.signal(Signal::STOP);
    }
    observer
}

/// Reads frames until the process is killed.
pub fn observe(instance: &str) {
    let instance = Instance::new(instance).expect("a plain name");
    let observer = Observer::frames(&instance).expect("observe");
    loop {
        let _ = observer.receive(Duration::from_secs(1)).expect("receive");
    }
}
