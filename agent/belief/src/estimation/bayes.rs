//! Bayes' rule at the cells that a frame shows (paper eqs. 5 and 10).

use crate::estimation::belief::Belief;
use emberwatch_model::grid::Probabilities;
use emberwatch_model::{Cell, Frame, Shape};
use ndarray::{Array2, NdFloat};
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

/// The same error as [`ZeroEvidence`], but with the cell's row-major index and probabilities of any float type.
#[derive(Debug, PartialEq)]
pub struct Impossible<T> {
    pub index: usize,
    pub observed: u8,
    /// The belief about the cell, one probability per state.
    pub belief: Vec<T>,
}

impl ZeroEvidence {
    fn of(impossible: Impossible<f32>, shape: Shape) -> Self {
        Self {
            cell: shape.cell(impossible.index),
            observed: impossible.observed,
            belief: impossible.belief,
        }
    }
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
    let shape = belief.shape();
    let dim = frame.values().dim();
    assert_eq!(dim, shape.dim(), "frame: expected the belief's grid");
    let corrected = correct_cells(belief.as_mut_slice(), likelihood, || frame.observed());
    corrected.map_err(|impossible| ZeroEvidence::of(impossible, shape))
}

/// Checks that [`correct`] accepts a frame.
///
/// # Errors
/// [`ZeroEvidence`] if `b(y)' u = 0` for some cell.
pub fn check(belief: &Belief, likelihood: &Array2<f64>, frame: &Frame) -> Result<(), ZeroEvidence> {
    let posteriors = posteriors(belief.as_slice(), likelihood, frame.observed());
    let possible = posteriors.map(drop);
    possible.map_err(|impossible| ZeroEvidence::of(impossible, belief.shape()))
}

/// Applies Bayes' rule as [`correct`] does, but to any list of cells. `probabilities` contains one contiguous block of
/// cells per state. `observed` lists the index and the value of each observed cell.
///
/// # Errors
/// [`Impossible`] for the first cell where `b(y)' u` is 0 or not finite. The probabilities are then unchanged.
///
/// # Panics
/// If a cell or a value is out of range.
pub fn correct_cells<T: NdFloat, I: Iterator<Item = (usize, u8)>>(
    probabilities: &mut [T],
    likelihood: &Array2<f64>,
    observed: impl Fn() -> I,
) -> Result<(), Impossible<T>> {
    let n_states = likelihood.nrows();
    let n_cells = probabilities.len() / n_states;
    // Posteriors are written back only after all observations have proved possible.
    let posteriors = posteriors(probabilities, likelihood, observed())?;
    for ((index, _), posterior) in observed().zip(posteriors.chunks_exact(n_states)) {
        let cell = probabilities[index..].iter_mut().step_by(n_cells);
        cell.zip(posterior).for_each(|(to, &p)| *to = p);
    }
    Ok(())
}

/// Returns the posterior of each observed cell, one cell after another.
fn posteriors<T: NdFloat>(
    probabilities: &[T],
    likelihood: &Array2<f64>,
    observed: impl Iterator<Item = (usize, u8)>,
) -> Result<Vec<T>, Impossible<T>> {
    let n_cells = probabilities.len() / likelihood.nrows();
    let mut posteriors: Vec<T> = Vec::new();
    for (index, observed) in observed {
        let prior = probabilities[index..].iter().step_by(n_cells);
        let likelihood = likelihood.column(usize::from(observed));
        // Compute in f64, because the product of two f32 values can underflow to zero in f32, but not in f64.
        let joint = || {
            let pairs = prior.clone().zip(&likelihood);
            pairs.map(|(&u, b)| u.to_f64().unwrap_or(f64::NAN) * b)
        };
        let evidence: f64 = joint().sum();
        if evidence <= 0.0 || !evidence.is_finite() {
            return Err(Impossible {
                index,
                observed,
                belief: prior.copied().collect(),
            });
        }
        let posterior = joint().map(|p| T::from(p / evidence).unwrap_or_else(T::nan));
        posteriors.extend(posterior);
    }
    Ok(posteriors)
}
