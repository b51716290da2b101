//! A filter's first belief. Its simulation can take long, so a log message announces it, and the result is cached for
//! later runs.

use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::kept_belief::KeptBelief;
use emberwatch_belief::estimation::prior::Prior;
use emberwatch_model::ModelError;
use emberwatch_model::{Model, Shape};
use std::cell::Cell;

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
        tracing::info!(
            worlds = n_worlds,
            steps = burn_in,
            "simulating the first belief"
        );
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
