//! What observers cost: a step's time with 0, 1, 4 and 16 of them, one of them stopped.

use crate::harness::{Paths, Server};
use crate::say;
use protocol::channels::Instance;
use protocol::control::{Reply, Request};
use protocol::message::{Operation, StepRequest};
use protocol::observer::Observer;
use protocol::path::path_to_bytes;
use rustix::process::{Pid, Signal, kill_process};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

const N_STEPS: usize = 20_000;

const TIMEOUT: Duration = Duration::from_secs(20);

/// An observer's process; killed on drop.
struct Process(Child);

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Prints the server's own time and the round trip for each number of observers, some rounds over.
pub fn compare(n_rounds: usize) {
    say("observers   server p50     p99   round trip p50     p99, us; the mean of all rounds");
    let numbers = [0, 1, 4, 16];
    let mut sums = [[0.0; 4]; 4];
    for _ in 0..n_rounds {
        for (n_observers, sums) in numbers.iter().zip(&mut sums) {
            let times = measure(*n_observers);
            sums.iter_mut()
                .zip(times)
                .for_each(|(sum, time)| *sum += time);
        }
    }
    for (n_observers, sums) in numbers.iter().zip(sums) {
        let [a, b, c, d] = sums.map(|sum| sum / n_rounds as f64);
        say(&format!(
            "{n_observers:>9} {a:>12.1} {b:>7.1} {c:>16.1} {d:>7.1}"
        ));
    }
}

/// Median and 99th percentile of the server's time for a step, then of the round trip, us.
fn measure(n_observers: usize) -> [f64; 4] {
    let server = Server::start("--burn-in 1000");
    let _observers: Vec<Process> = (0..n_observers).map(|n| start(&server, n == 1)).collect();
    std::thread::sleep(Duration::from_millis(500));
    let mut connection = server.connect();
    let acquire = Request::Acquire {
        first_world: 0,
        n_worlds: 1,
        takeover: false,
        ttl_millis: None,
    };
    let Ok(Reply::Lease(lease)) = connection.control(&acquire, TIMEOUT) else {
        panic!("expected a lease");
    };
    let request = StepRequest {
        operation: Operation::Step as u32,
        lease: lease.lease,
        n_worlds: 1,
        n_moves: 64,
        ..StepRequest::default()
    };
    let mut paths = Paths::new(0);
    let (mut work, mut trips) = (Vec::new(), Vec::new());
    let mut last = Instant::now();
    for n in 0..N_STEPS {
        let path = path_to_bytes(&paths.next(64));
        // As an agent that plans for a while: 2,000 steps a second, not as many as there can be.
        while last.elapsed() < Duration::from_micros(500) {
            std::hint::spin_loop();
        }
        last = Instant::now();
        let answer = connection.step(request, &path, TIMEOUT).expect("a step");
        if n > N_STEPS / 10 {
            work.push(answer.reply.simulation_nanos as f64 / 1e3);
            trips.push(last.elapsed().as_secs_f64() * 1e6);
        }
    }
    let at = |times: &mut Vec<f64>, q: f64| {
        times.sort_by(f64::total_cmp);
        times[(times.len() as f64 * q) as usize]
    };
    [
        at(&mut work, 0.5),
        at(&mut work, 0.99),
        at(&mut trips, 0.5),
        at(&mut trips, 0.99),
    ]
}

fn start(server: &Server, is_stopped: bool) -> Process {
    let program = std::env::current_exe().expect("this program");
    let mut command = Command::new(program);
    command
        .args(["observe", server.instance.name()])
        .stdout(Stdio::null());
    let process = Process(command.spawn().expect("an observer"));
    std::thread::sleep(Duration::from_millis(50));
    if is_stopped {
        let pid = Pid::from_raw(process.0.id() as i32).expect("a process id");
        kill_process(pid, Signal::STOP).expect("stop it");
    }
    process
}

/// Reads frames without end.
pub fn observe(instance: &str) {
    let instance = Instance::new(instance).expect("a plain name");
    let observer = Observer::frames(&instance).expect("observe");
    loop {
        let _ = observer.receive(Duration::from_secs(1)).expect("receive");
    }
}
