//! Simulators for tests.

use super::state::{ResetJob, Simulator};
use crate::config::ServerConfig;
use rayon::ThreadPoolBuilder;

/// Creates a simulator in its first burn-in, and the jobs that end it. The token of the first lease is 1.
pub fn new_simulator(config: ServerConfig) -> (Simulator, Vec<ResetJob>) {
    let threads = ThreadPoolBuilder::new().num_threads(1).build();
    let mut token = 0;
    let next_token = Box::new(move || {
        token += 1;
        token
    });
    let checked = config.check().expect("valid settings");
    Simulator::new(checked, threads.expect("a thread"), next_token).expect("a valid model")
}

pub fn finish(simulator: &mut Simulator, jobs: Vec<ResetJob>) {
    for job in jobs {
        let (world, episode) = job.run(&simulator.spec().rules);
        simulator.put(world, episode);
    }
}
