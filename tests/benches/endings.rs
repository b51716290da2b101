//! How soon the death of a process is noticed: `cargo bench -p tests --bench endings`.
//!
//! Peer: this process's own notice of the same death, by a pidfd. Then, how much of a replay at full speed
//! reaches an observer that reads.

#[expect(dead_code, reason = "the tests use all of it")]
#[path = "../harness.rs"]
mod harness;

use harness::{PATIENCE, Program, Server, eventually, new_instance};
use protocol::control::Request;
use protocol::observer::Observer;
use protocol::recording::Reader;
use protocol::wait::sleep_until_readable;
use rustix::process::{Pid, PidfdFlags, Signal, pidfd_open};
use std::fs::File;
use std::os::fd::AsFd;
use std::time::{Duration, Instant};
use tempfile::TempDir;

const N_ROUNDS: usize = 30;

/// A grid on which a step is short.
const FLAGS: &str = "--height 5 --width 7 --moves 6 --burn-in 20";

fn main() {
    report("a killed agent's world is acquired", killed_agent);
    report("a client waits on a killed server", killed_server);
    report_replay();
}

/// Prints the median and the longest time, and their ratio to the peer's median.
fn report(what: &str, mut measure: impl FnMut() -> (Duration, Duration)) {
    let times: Vec<_> = (0..N_ROUNDS).map(|_| measure()).collect();
    let sorted = |time: fn(&(Duration, Duration)) -> Duration| {
        let mut millis: Vec<f64> = times
            .iter()
            .map(|both| time(both).as_secs_f64() * 1e3)
            .collect();
        millis.sort_unstable_by(f64::total_cmp);
        (millis[N_ROUNDS / 2], millis[N_ROUNDS - 1])
    };
    let ((median, longest), (peer, _)) = (sorted(|both| both.0), sorted(|both| both.1));
    say(&format!(
        "{what:<35} p50 {median:7.2} max {longest:7.2} ms, {:.1} times a pidfd's {peer:.2} ms",
        median / peer
    ));
}

/// Kills a program; how long until `notice` returns, and until a pidfd says so.
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
    let server = Server::start(FLAGS);
    let mut next = server.connect();
    let flags = ["run", "--instance", server.instance.name()];
    let agent = Program::start("emberwatch-agent", &flags);
    assert!(eventually(PATIENCE, || server.step_of(0) > 0));
    let request = Request::Acquire {
        first_robot: 0,
        n_robots: 1,
        takeover: false,
        ttl_millis: None,
    };
    let mut acquires = || next.control(&request, PATIENCE).is_ok();
    kill(&agent, || assert!(eventually(PATIENCE, &mut acquires)))
}

fn killed_server() -> (Duration, Duration) {
    let server = Server::start(FLAGS);
    let mut connection = server.connect();
    server.program.stop();
    kill(&server.program, || {
        let answer = connection.control(&Request::Status {}, PATIENCE);
        assert!(answer.is_err(), "{answer:?}");
    })
}

fn report_replay() {
    let folder = TempDir::new().expect("a folder");
    let path = folder.path().join("bench.recording");
    let file = path.to_str().expect("a plain path");
    record(file);
    let mut reader = Reader::new(File::open(&path).expect("the file")).expect("a recording");
    reader
        .by_ref()
        .for_each(|record| drop(record.expect("whole")));
    let n_frames = reader.totals().n_frames;
    let instance = new_instance();
    let observer = Observer::frames(&instance).expect("observe");
    let flags = [
        "replay",
        file,
        "--instance",
        instance.name(),
        "--speed",
        "max",
    ];
    let mut replay = Program::start("emberwatch-server", &flags);
    let (began, mut n_read) = (Instant::now(), 0);
    let mut last = began;
    // It stays a few seconds for those who read.
    while !replay.has_ended() {
        while observer.try_receive().expect("receive").is_some() {
            (n_read, last) = (n_read + 1, Instant::now());
        }
        std::thread::sleep(Duration::from_micros(500));
    }
    say(&format!(
        "replay at full speed: an observer reads {:.1} % of {n_frames} frames in {:.2} s",
        100.0 * n_read as f64 / n_frames as f64,
        (last - began).as_secs_f64()
    ));
}

fn record(file: &str) {
    let server = Server::start(FLAGS);
    let name = server.instance.name();
    let flags = ["record", "--instance", name, "--out", file];
    let recorder = Program::start("emberwatch-server", &flags);
    recorder.wait_for_words("recording", PATIENCE);
    let flags = [
        "run",
        "--instance",
        name,
        "--policy",
        "random_walk",
        "--steps",
        "20000",
    ];
    let agent = Program::start("emberwatch-agent", &flags);
    assert_eq!(agent.wait(4 * PATIENCE).code, Some(0));
    recorder.signal(Signal::INT);
    assert_eq!(recorder.wait(PATIENCE).code, Some(0));
}

#[expect(clippy::print_stdout, reason = "a benchmark's output")]
fn say(line: &str) {
    println!("{line}");
}
