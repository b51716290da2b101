//! Servers that are killed at random moments and come back from their last snapshot.

use emberwatch_protocol::Client;
use emberwatch_protocol::client::Observation;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use std::collections::HashMap;
use std::time::{Duration, Instant};
use tempfile::TempDir;
use tests::harness::{Paths, Server, new_instance};
use tests::report::{say, spread};

const FLAGS: &str = "--height 64 --width 64 --moves 64 --burn-in 1000 --worlds 2";

const N_MOVES: usize = 64;

fn paths(step: u64) -> Vec<Vec<emberwatch_protocol::Move>> {
    Paths::new(step).take(N_MOVES, 2)
}

/// Kills so many servers; compares every observation with those of a server where nothing happened.
pub fn kill(n_kills: usize) {
    let folder = TempDir::new().expect("a folder");
    let path = folder.path().display();
    let flags = format!("{FLAGS} --snapshot-every 100 --snapshot-dir {path} --restore {path}");
    let (instance, undisturbed) = (new_instance(), Server::start(FLAGS));
    let mut true_world = undisturbed.acquire(0..2);
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    let mut known: HashMap<u64, Vec<Observation>> = HashMap::new();
    let (mut waits, mut redone, mut furthest) = (Vec::new(), 0, 0);
    for n in 0..=n_kills {
        let started = Instant::now();
        let server = Server::start_on(&instance, &flags);
        let mut client = server.take_over(0..2);
        let mut seen = client.observe(0..2).expect("observe");
        waits.push(started.elapsed().as_secs_f64());
        let stands = seen[0].world.step;
        redone += furthest - stands;
        // Now and then the last kill came before the next snapshot.
        let until = Instant::now() + Duration::from_millis(rng.random_range(5..60));
        while Instant::now() < until {
            let step = seen[0].world.step;
            if step > 0 {
                check(&mut true_world, &mut known, step, &seen);
            }
            seen = client.step(0..2, &paths(step)).expect("step");
        }
        check(&mut true_world, &mut known, seen[0].world.step, &seen);
        furthest = furthest.max(seen[0].world.step);
        if n < n_kills {
            server.kill();
        }
    }
    say(&format!(
        "{n_kills} servers killed; {furthest} steps, {redone} of them made again after a restart"
    ));
    say(&format!(
        "every observation of every life equals the undisturbed server's; back after {}",
        spread(waits)
    ));
}

/// Compares an observation with the undisturbed server's, which is brought there.
fn check(
    undisturbed: &mut Client,
    known: &mut HashMap<u64, Vec<Observation>>,
    step: u64,
    seen: &[Observation],
) {
    while !known.contains_key(&step) {
        let at = known.len() as u64;
        known.insert(at + 1, undisturbed.step(0..2, &paths(at)).expect("step"));
    }
    assert_eq!(known[&step], seen, "step {step}");
}
