//! Programs that are killed while they start, end or connect, in five loops at once; then every name must start.

use std::time::{Duration, Instant};
use tests::harness::{Server, status};
use tests::kills::{FLAGS, Kills, files_of, kill_in_loops, look_up_nobody};
use tests::meter::Use;
use tests::report::{say, spread};

const N_LOOPS: usize = 5;

/// A server notices within a quarter of a second that its clients have died.
const SETTLED: Duration = Duration::from_secs(1);

/// How long it may take to learn that nobody serves an instance, or until one that is free is served.
const LONGEST: f64 = 1.0;

/// Kills so many servers in their start, and a quarter as many each in their end and of those who connect.
pub fn kill(n_starts: usize) {
    let witness = Server::start("--burn-in 0");
    std::thread::sleep(SETTLED);
    let before = Use::of(witness.program.pid());
    let each = Kills {
        starts: n_starts / N_LOOPS,
        ends: n_starts / N_LOOPS / 4,
        connects: n_starts / N_LOOPS / 4,
        with_python: true,
    };
    let started = Instant::now();
    let left = kill_in_loops(N_LOOPS as u64, each);
    say(&format!(
        "{} programs killed in {:.0} s: {} in their start, {} in their end, {} while they connected",
        left.killed.len(),
        started.elapsed().as_secs_f64(),
        each.starts * N_LOOPS,
        each.ends * N_LOOPS,
        each.connects * N_LOOPS
    ));
    let look_ups: Vec<f64> = (0..100).map(|_| look_up_nobody().as_secs_f64()).collect();
    assert!(look_ups.iter().all(|&seconds| seconds < LONGEST));
    say(&format!("looking for nobody: {}", spread(look_ups)));
    let mut starts = Vec::new();
    for instance in &left.instances {
        let start = Instant::now();
        let server = Server::start_on(instance, FLAGS);
        starts.push(start.elapsed().as_secs_f64());
        server.program.finish();
    }
    assert!(starts.iter().all(|&seconds| seconds < LONGEST));
    say(&format!("{} names start: {}", starts.len(), spread(starts)));
    assert!(status(&witness.instance).is_ok(), "the witness serves");
    std::thread::sleep(SETTLED);
    say(&format!("a server that watched, before: {before}"));
    let after = Use::of(witness.program.pid());
    say(&format!("                      after:  {after}"));
    assert_eq!(after.descriptors, before.descriptors);
    let files = files_of(&left);
    assert!(
        files.is_empty(),
        "{} files, such as {:?}",
        files.len(),
        files[0]
    );
}
