//! Agents that are killed at random moments, one after the other, on one server.

use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::message::FrameHeader;
use emberwatch_protocol::observer::{Observer, Sample};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rustix::process::Signal;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use tests::harness::{PATIENCE, Program, Server, eventually};
use tests::meter::Use;
use tests::mirror::Mirror;
use tests::report::{say, spread};
use tests::wire::acquire_request;

const FLAGS: &str = "--height 64 --width 64 --moves 64 --burn-in 1000";

/// Kills so many agents; compares all that was published with a world where nothing happened.
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
    let mut mirror = Mirror::of(&server.info());
    let n_compared = frames.iter().filter(|sample| mirror.follow(sample)).count();
    assert_eq!(n_compared as u64, last, "a step was not published");
    say(&format!(
        "{n_compared} steps, each made once, all equal to those of an undisturbed world"
    ));
}

/// Starts an agent, kills it after some steps; seconds from the kill until its world can be had.
fn one(server: &Server, rng: &mut ChaCha8Rng) -> f64 {
    let mut next = server.connect();
    let at = server.step_of(0);
    let agent = Program::agent(&server.instance, "--policy coverage --takeover");
    agent.until(|| server.step_of(0) > at);
    std::thread::sleep(Duration::from_micros(rng.random_range(0..5_000)));
    agent.signal(Signal::KILL);
    let killed = Instant::now();
    let mut acquires = || next.control(&acquire_request(0..1), PATIENCE).is_ok();
    assert!(eventually(PATIENCE, &mut acquires));
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
