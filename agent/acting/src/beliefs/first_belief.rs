//! A filter's first belief. Its simulation can take long, so a log message announces it, and the result is cached for
//! later runs.

use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::kept_belief::KeptBelief;
use emberwatch_belief::estimation::prior::Prior;
use emberwatch_model::ModelError;
use emberwatch_model::{Model, Shape};
use std::cell::Cell;

/// Number of cell updates that one core simulates per second: one step of 64 x 64 cells of the wildfire takes 3.4 us.
const CELLS_PER_SECOND: f64 = 1.2e9;

/// Returns the belief before the first frame, from the cache if possible. See [`Prior::belief`].
pub fn first_belief(
    prior: Prior,
    model: &Model,
    shape: Shape,
    seed: u64,
) -> Result<Belief, ModelError> {
    let Prior::Simulated { n_worlds, burn_in } = prior else {
        return prior.belief(model, shape, seed);
    };
    let make = || {
        announce(n_worlds, burn_in, shape);
        prior.belief(model, shape, seed)
    };
    let is_told = Cell::new(false);
    let pause = |time| {
        if !is_told.replace(true) {
            tracing::info!("another process simulates the first belief: waiting for it");
        }
        std::thread::sleep(time);
        Ok(())
    };
    match KeptBelief::new(prior, model, shape, seed) {
        Some(kept) => kept.read_or_make(pause, make),
        None => make(),
    }
}

/// Logs that a simulation begins, and how long it may take.
fn announce(n_worlds: usize, burn_in: u64, shape: Shape) {
    let cells = n_worlds as f64 * burn_in as f64 * shape.n_cells() as f64;
    let seconds = cells / CELLS_PER_SECOND / rayon::current_num_threads() as f64;
    tracing::info!(
        worlds = n_worlds,
        steps = burn_in,
        about_seconds = seconds.ceil(),
        "simulating the first belief"
    );
}
