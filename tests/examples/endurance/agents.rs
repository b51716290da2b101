//! Agents that are killed at random moments, one after the other, on one server.

use crate::harness::{Program, Server, eventually, fly, path_of, seen_by, seen_in};
use crate::meter::Use;
use crate::{say, spread};
use protocol::channels::Instance;
use protocol::control::Request;
use protocol::message::FrameHeader;
use protocol::observer::{Observer, Sample};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rustix::process::Signal;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

const FLAGS: &str = "--height 64 --width 64 --moves 64 --burn-in 1000";

const PATIENCE: Duration = Duration::from_secs(20);

/// Kills so many agents; compares all that was published with a server where nothing happened.
pub fn kill(n_kills: usize) {
    let server = Server::start(FLAGS);
    let stop = AtomicBool::new(false);
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    let mut waits = Vec::new();
    let mut before = None;
    let started = Instant::now();
    let frames = std::thread::scope(|scope| {
        let frames = scope.spawn(|| collect(&server.instance, &stop));
        std::thread::sleep(Duration::from_millis(300)); // It is there by now.
        for n in 0..n_kills {
            if n == n_kills / 10 {
                before = Some(Use::of(server.program.pid()));
            }
            waits.push(one(&server, &mut rng));
        }
        std::thread::sleep(Duration::from_secs(5)); // The cleaner looks each two.
        stop.store(true, Ordering::Relaxed);
        frames.join().expect("the observer")
    });
    let seconds = started.elapsed().as_secs_f64();
    say(&format!(
        "{n_kills} agents killed in {seconds:.0} s; the same server process answers"
    ));
    say(&format!("next acquire after a kill: {}", spread(waits)));
    if let Some(before) = before {
        say(&format!("after a tenth of them: {before}"));
        say(&format!(
            "at the end:            {}",
            Use::of(server.program.pid())
        ));
    }
    let last = server.step_of(0);
    let n_compared = compare(&frames);
    assert_eq!(
        n_compared, last,
        "a step was published twice, or not at all"
    );
    say(&format!(
        "{n_compared} steps, each made once, all equal to those of an undisturbed server"
    ));
}

/// Starts an agent, kills it after some steps; seconds from the kill until its world can be had.
fn one(server: &Server, rng: &mut ChaCha8Rng) -> f64 {
    let mut next = server.connect();
    let at = server.step_of(0);
    let flags = [
        "run",
        "--instance",
        server.instance.name(),
        "--policy",
        "coverage",
        "--takeover",
    ];
    let agent = Program::start("emberwatch-agent", &flags);
    assert!(
        eventually(PATIENCE, || server.step_of(0) > at),
        "{}",
        agent.stderr()
    );
    std::thread::sleep(Duration::from_micros(rng.random_range(0..5_000)));
    agent.signal(Signal::KILL);
    let killed = Instant::now();
    let request = Request::Acquire {
        first_robot: 0,
        n_robots: 1,
        takeover: false,
        ttl_millis: None,
    };
    assert!(eventually(PATIENCE, || next
        .control(&request, PATIENCE)
        .is_ok()));
    killed.elapsed().as_secs_f64()
}

fn collect(instance: &Instance, stop: &AtomicBool) -> Vec<Sample<FrameHeader>> {
    let observer = Observer::frames(instance).expect("observe");
    let mut frames = Vec::new();
    while !stop.load(Ordering::Relaxed) {
        frames.extend(
            observer
                .receive(Duration::from_millis(100))
                .expect("receive"),
        );
    }
    let lost = frames
        .windows(2)
        .filter(|pair| pair[1].header.sequence != pair[0].header.sequence + 1);
    assert_eq!(
        lost.count(),
        0,
        "the observer of this check was too slow: give it a core of its own"
    );
    frames
}

/// Flies what was published on a new server; returns how many steps that were.
fn compare(frames: &[Sample<FrameHeader>]) -> u64 {
    let server = Server::start(FLAGS);
    let mut client = server.acquire(0..1);
    let mut last = 0;
    for sample in frames {
        let step = sample.header.result.step;
        if step == last {
            continue; // Shown again to an observer that has just come: none has, but may.
        }
        assert_eq!(step, last + 1, "a step is missing");
        let seen = fly(&mut client, path_of(sample));
        assert_eq!(seen_by(&seen), seen_in(sample));
        last = step;
    }
    last
}
