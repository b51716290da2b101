//! Time of a decision from a learner outside to the agent, through the server and back:
//! `cargo bench -p tests --bench decide`; arguments after `--` go to the agent.
//!
//! Prints median and tail over the decisions of one episode on the default grid.

use std::time::Instant;
use tests::harness::Server;
use tests::learner::{Learner, start_with_learner};
use tests::report::{quantiles, say};

const N_DECISIONS: usize = 1000;

fn main() {
    let server = Server::start("");
    // cargo adds `--bench` on its own.
    let more = std::env::args()
        .skip(1)
        .filter(|argument| argument != "--bench");
    let flags: Vec<String> = more.collect();
    let (_agent, learner) = start_with_learner(&server.instance, &flags.join(" "));
    learner.reset(1);
    (0..N_DECISIONS / 10).for_each(|_| _ = micros(&learner, 2));
    for (objective, what) in [(2, "a state"), (3, "entropy")] {
        let times = (0..N_DECISIONS).map(|_| micros(&learner, objective));
        let [median, high] = quantiles(times.collect(), [0.5, 0.99]);
        say(&format!(
            "a decision for {what:<8} p50 {median:7.1} p99 {high:7.1} us"
        ));
    }
}

/// Microseconds of one decision.
fn micros(learner: &Learner, objective: u64) -> f64 {
    let start = Instant::now();
    learner.decide(objective);
    start.elapsed().as_secs_f64() * 1e6
}
