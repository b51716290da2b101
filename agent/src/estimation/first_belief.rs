//! A filter's first belief, announced, as simulating it may take long.

use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::prior::Prior;
use emberwatch_protocol::model::ModelError;
use emberwatch_protocol::{Model, Shape};

/// Cells that a core moves by one step in a second: 64 x 64 of the wildfire in 3.4 us.
const CELLS_PER_SECOND: f64 = 1.2e9;

/// The belief before the first frame, see [`Prior::belief`].
pub fn first_belief(
    prior: Prior,
    model: &Model,
    shape: Shape,
    seed: u64,
) -> Result<Belief, ModelError> {
    if let Prior::Simulated { n_worlds, burn_in } = prior {
        let cells = n_worlds as f64 * burn_in as f64 * shape.n_cells() as f64;
        let seconds = cells / CELLS_PER_SECOND / rayon::current_num_threads() as f64;
        tracing::info!(
            worlds = n_worlds,
            steps = burn_in,
            about_seconds = seconds.ceil(),
            "simulating the first belief"
        );
    }
    prior.belief(model, shape, seed)
}
