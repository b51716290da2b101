//! Priors: beliefs before the first frame, and their simulation.

use crate::errors::{check_memory, no_threads, raised};
use crate::model::{model_of, shape_of};
use crate::refusal::refused;
use crate::threads::watched;
use emberwatch_belief::{Belief, estimation::KeptBelief, estimation::Prior};
use emberwatch_model::{Model, Shape};
use numpy::{PyArray3, ToPyArray};
use pyo3::prelude::*;
use rayon::ThreadPoolBuilder;

/// Simulates 64 worlds. Returns the share of worlds in which each cell is in each state after the burn-in, `[S, H, W]`.
#[pyfunction]
pub fn simulated_prior<'py>(
    py: Python<'py>,
    model: &str,
    height: usize,
    width: usize,
    burn_in: u64,
) -> PyResult<Bound<'py, PyArray3<f32>>> {
    let (model, shape) = (model_of(model)?, shape_of(py, height, width)?);
    let n_worlds = Prior::N_WORLDS;
    let prior = Prior::Simulated { n_worlds, burn_in };
    let belief = first_belief(py, prior, &model, shape)?;
    Ok(belief.probabilities().to_pyarray(py))
}

/// Returns the belief before the first frame. Caches a simulated belief in a file for other processes. Ctrl-C ends the
/// wait for another process that simulates it.
pub fn first_belief(py: Python<'_>, prior: Prior, model: &Model, shape: Shape) -> PyResult<Belief> {
    let is_simulated = matches!(prior, Prior::Simulated { .. });
    let kept = is_simulated.then(|| KeptBelief::new(prior, model, shape, 0));
    let pause = |time| {
        py.detach(|| std::thread::sleep(time));
        py.check_signals()
    };
    let make = || simulated(py, prior, model, shape);
    match kept.flatten() {
        Some(kept) => kept.read_or_make(pause, make),
        None => make(),
    }
}

/// Simulates a prior on new threads, because a global pool is unusable after a fork. Ctrl-C ends the simulation.
fn simulated(py: Python<'_>, prior: Prior, model: &Model, shape: Shape) -> PyResult<Belief> {
    let n_threads = std::thread::available_parallelism().map_or(1, usize::from);
    // Each thread simulates one world at a time, and counts for each cell how often each state occurs.
    let of_thread = shape.n_cells() * (model.n_states() * size_of::<u32>() + 5);
    let n_bytes = 2 * n_threads * of_thread;
    check_memory(py, "the worlds of a first belief", n_bytes)?;
    let pool = emberwatch_sim::limits::start(ThreadPoolBuilder::new(), n_threads);
    let pool = pool.map_err(|short| no_threads(py, &short))?;
    let made = py.detach(|| {
        watched(&pool, |cancelled| {
            prior.belief_unless(cancelled, model, shape, 0)
        })
    });
    let belief = made.ok_or_else(raised)?;
    let belief = belief.map_err(|error| refused(py, error))?;
    Ok(belief.expect("invariant: `watched` alone cancels it"))
}
