//! Measures how soon programs notice the death of a process: `cargo bench -p tests --bench endings`.
//!
//! The reference is the time after which a pidfd reports the same death to this process.

use emberwatch_protocol::control::Request;
use emberwatch_protocol::wait::sleep_until_readable;
use rustix::process::{Pid, PidfdFlags, Signal, pidfd_open};
use std::os::fd::AsFd;
use std::time::{Duration, Instant};
use tests::harness::{PATIENCE, Program, SMALL, Server, eventually};
use tests::report::{quantiles, say};
use tests::wire::acquire_request;

const N_ROUNDS: usize = 30;

fn main() {
    report("a killed agent's world is acquired", killed_agent);
    report("a client waits on a killed server", killed_server);
}

/// Prints the median and the maximum time, and the ratio of the median to the reference's median.
fn report(what: &str, mut measure: impl FnMut() -> (Duration, Duration)) {
    let times: Vec<_> = (0..N_ROUNDS).map(|_| measure()).collect();
    let millis = |time: fn(&(Duration, Duration)) -> Duration| {
        let millis = times.iter().map(|both| time(both).as_secs_f64() * 1e3);
        quantiles(millis.collect(), [0.5, 1.0])
    };
    let ([median, longest], [peer, _]) = (millis(|both| both.0), millis(|both| both.1));
    say(&format!(
        "{what:<35} p50 {median:7.2} max {longest:7.2} ms, {:.1} times a pidfd's {peer:.2} ms",
        median / peer
    ));
}

/// Kills a program. Returns the time until `notice` returns, and the time until a pidfd reports the death.
fn kill(program: &Program, notice: impl FnOnce()) -> (Duration, Duration) {
    let pid = Pid::from_raw(program.pid() as i32).expect("a process id");
    let process = pidfd_open(pid, PidfdFlags::empty()).expect("a process");
    std::thread::scope(|scope| {
        let killer = scope.spawn(|| {
            std::thread::sleep(Duration::from_millis(20)); // The waiting process sleeps by now.
            let killed = Instant::now();
            program.signal(Signal::KILL);
            sleep_until_readable(&[process.as_fd()], PATIENCE).expect("wait");
            (killed, killed.elapsed())
        });
        notice();
        let noticed = Instant::now();
        let (killed, peer) = killer.join().expect("killed");
        (noticed.saturating_duration_since(killed), peer)
    })
}

fn killed_agent() -> (Duration, Duration) {
    let server = Server::start(SMALL);
    let mut next = server.connect();
    let agent = Program::agent(&server.instance, "");
    agent.until(|| server.step_of(0) > 0);
    let mut acquires = || next.control(&acquire_request(0..1), PATIENCE).is_ok();
    kill(&agent, || assert!(eventually(PATIENCE, &mut acquires)))
}

fn killed_server() -> (Duration, Duration) {
    let server = Server::start(SMALL);
    let mut connection = server.connect();
    server.program.stop();
    kill(&server.program, || {
        let answer = connection.control(&Request::Status {}, PATIENCE);
        assert!(answer.is_err(), "{answer:?}");
    })
}
