//! Bayes' rule at the cells that a frame shows (paper eqs. 5 and 10).

use crate::estimation::belief::Belief;
use emberwatch_model::grid::Probabilities;
use emberwatch_model::{Cell, Frame};
use ndarray::Array2;
use thiserror::Error;

/// The error about an observation that is impossible under the belief.
#[derive(Debug, Error, PartialEq)]
#[error(
    "frame: cell {cell}: expected an observation that the belief {belief:?} allows, got {observed}"
)]
pub struct ZeroEvidence {
    pub cell: Cell,
    pub observed: u8,
    /// The belief about the cell, one probability per state.
    pub belief: Vec<f32>,
}

/// Computes the distribution of each cell's observation under a belief, `B' u`, shape `[O, H, W]`. `likelihood` is
/// `P(y | x)`, shape `[S, O]`.
///
/// # Panics
/// If the belief and the likelihood have different numbers of states.
pub fn observations(belief: &Belief, likelihood: &Array2<f64>) -> Probabilities {
    let (height, width) = belief.shape().dim();
    let (n_states, n_observations) = likelihood.dim();
    let states = belief.view();
    let states = states.to_shape((n_states, height * width));
    let states = states.expect("likelihood: expected the belief's number of states");
    let observations = likelihood.t().mapv(|p| p as f32).dot(&states);
    let dim = (n_observations, height, width);
    let observations = observations.into_shape_with_order(dim);
    observations.expect("invariant: one number per observation and cell")
}

/// Applies Bayes' rule to the cells that a frame shows: `p = B(y) u / (b(y)' u)` (eq. 5). Cells that the frame does not
/// show keep `p = u`. `likelihood` is `P(y | x)`, shape `[S, O]`.
///
/// # Errors
/// [`ZeroEvidence`] if `b(y)' u = 0` for some cell. The belief is then unchanged.
///
/// # Panics
/// If the frame's grid differs from the belief's, or the likelihood lacks one of the frame's observations.
pub fn correct(
    belief: &mut Belief,
    likelihood: &Array2<f64>,
    frame: &Frame,
) -> Result<(), ZeroEvidence> {
    let dim = frame.values().dim();
    assert_eq!(
        dim,
        belief.shape().dim(),
        "frame: expected the belief's grid"
    );
    // Posteriors are written only after all observations have proved possible.
    let posteriors = posteriors(belief, likelihood, frame)?;
    let n_cells = belief.shape().n_cells();
    let probabilities = belief.as_mut_slice();
    let posteriors = posteriors.chunks_exact(likelihood.nrows());
    for ((index, _), posterior) in frame.observed().zip(posteriors) {
        let cell = probabilities[index..].iter_mut().step_by(n_cells);
        cell.zip(posterior).for_each(|(to, &p)| *to = p);
    }
    Ok(())
}

/// Checks that [`correct`] accepts a frame.
///
/// # Errors
/// [`ZeroEvidence`] if `b(y)' u = 0` for some cell.
pub fn check(belief: &Belief, likelihood: &Array2<f64>, frame: &Frame) -> Result<(), ZeroEvidence> {
    posteriors(belief, likelihood, frame).map(drop)
}

fn posteriors(
    belief: &Belief,
    likelihood: &Array2<f64>,
    frame: &Frame,
) -> Result<Vec<f32>, ZeroEvidence> {
    let n_cells = belief.shape().n_cells();
    let mut posteriors = Vec::new();
    for (index, observed) in frame.observed() {
        let prior = belief.as_slice()[index..].iter().step_by(n_cells);
        let likelihood = likelihood.column(usize::from(observed));
        // Compute in f64, because the product of two f32 values can underflow to zero in f32, but not in f64.
        let joint = || {
            let pairs = prior.clone().zip(&likelihood);
            pairs.map(|(&u, b)| f64::from(u) * b)
        };
        let evidence: f64 = joint().sum();
        if evidence <= 0.0 || !evidence.is_finite() {
            return Err(ZeroEvidence {
                cell: belief.shape().cell(index),
                observed,
                belief: prior.copied().collect(),
            });
        }
        posteriors.extend(joint().map(|p| (p / evidence) as f32));
    }
    Ok(posteriors)
}
