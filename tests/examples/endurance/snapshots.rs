//! Measures how much automatic snapshots (`--snapshot-every 1000`, to a temporary folder) slow a client that steps as
//! fast as it can.

use emberwatch_protocol::path::path_to_bytes;
use std::time::Instant;
use tempfile::TempDir;
use tests::harness::{Paths, Server};
use tests::report::{range, say};
use tests::stepper::Stepper;

const N_STEPS: usize = 100_000;

/// Measures the time of a step without and with snapshots, alternately. Prints both times and their ratio.
pub fn compare(n_rounds: usize) {
    let (mut without, mut with, mut ratios) = (Vec::new(), Vec::new(), Vec::new());
    for round in 0..n_rounds {
        let folder = TempDir::new().expect("a folder");
        let flags = format!(
            "--snapshot-every 1000 --snapshot-dir {}",
            folder.path().display()
        );
        if round.is_multiple_of(2) {
            without.push(measure(""));
        }
        with.push(measure(&flags));
        if !round.is_multiple_of(2) {
            without.push(measure(""));
        }
        ratios.push(with[with.len() - 1] / without[without.len() - 1]);
    }
    say(&format!(
        "{N_STEPS} steps, us each: median (least-most) of {n_rounds} pairs"
    ));
    say(&format!(
        "without {}   with {}   ratio {}",
        range(without, 2),
        range(with, 2),
        range(ratios, 3)
    ));
}

/// Returns the time of a step in microseconds.
fn measure(flags: &str) -> f64 {
    let server = Server::start(&format!("--burn-in 1000 {flags}"));
    let mut stepper = Stepper::new(server.connect(), 0..1);
    let n_moves = stepper.connection.info().n_moves;
    let path = path_to_bytes(&Paths::new(0).next(n_moves));
    let mut step = || _ = stepper.step(&path);
    (0..N_STEPS / 20).for_each(|_| step());
    let start = Instant::now();
    (0..N_STEPS).for_each(|_| step());
    start.elapsed().as_secs_f64() * 1e6 / N_STEPS as f64
}
