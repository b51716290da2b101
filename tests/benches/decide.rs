//! Time of a decision from a learner outside to the agent, through the server and back:
//! `cargo bench -p tests --bench decide`; arguments after `--` go to the agent.
//!
//! Prints median and tail over the decisions of one episode on the default grid, for one world and for 64 at once.

use std::time::Instant;
use tests::harness::Server;
use tests::learner::{Learner, start_with_learner};
use tests::report::{quantiles, say};

fn main() {
    // cargo adds `--bench` on its own.
    let more = std::env::args()
        .skip(1)
        .filter(|argument| argument != "--bench");
    let more: Vec<String> = more.collect();
    for (n_worlds, n_decisions) in [(1, 1000), (64, 100)] {
        let worlds = format!("--worlds {n_worlds}");
        let server = Server::start(&worlds);
        let flags = format!("{worlds} {}", more.join(" "));
        let (_agent, learner) = start_with_learner(&server.instance, &flags);
        let seeds: Vec<(u32, u64)> = (0..n_worlds).map(|world| (world, world.into())).collect();
        learner.reset_some(&seeds);
        let decisions = vec![Some(0); seeds.len()];
        (0..n_decisions / 10).for_each(|_| _ = micros(&learner, &decisions));
        let times = (0..n_decisions).map(|_| micros(&learner, &decisions));
        let [median, high] = quantiles(times.collect(), [0.5, 0.99]);
        say(&format!(
            "decisions for {n_worlds:2} worlds p50 {median:8.1} p99 {high:8.1} us"
        ));
    }
}

/// Microseconds of one decision in each world.
fn micros(learner: &Learner, decisions: &[Option<u64>]) -> f64 {
    let start = Instant::now();
    learner.decide_all(decisions);
    start.elapsed().as_secs_f64() * 1e6
}
