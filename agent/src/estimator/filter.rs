//! The Bayes filter for a known model (paper section III.A, in the masked form of section III.C).
//!
//! A frame turns the predictor `u_k` into the posterior `p_k` (eq. 5); the transition turns that into
//! the next predictor `u_{k+1} = Phi(p_k)` (eq. 6). Cells are treated as independent given the
//! frames, so this is an approximation even with the true model.

use crate::belief::Belief;
use ndarray::Array2;
use protocol::frame::Frame;
use protocol::grid::{Cell, Probabilities};
use protocol::model::{Model, ModelError};
use protocol::transition::Transition;
use thiserror::Error;

/// Filter of one world: call [`Filter::correct`] with each frame and [`Filter::predict`] after it.
#[derive(Debug, Clone)]
pub struct Filter {
    transition: Transition,
    /// `P(y | x)`, shape `[O, S]`: the likelihood vectors `b(y)` of eq. 5 as rows.
    likelihood: Array2<f64>,
    belief: Belief,
    /// Where the transition writes.
    predictor: Probabilities,
    /// The posteriors of a frame's cells, until the whole frame is known to be possible.
    posteriors: Vec<f32>,
}

/// A frame that the belief holds impossible.
#[derive(Debug, Error, PartialEq)]
#[error(
    "frame: cell {cell}: expected an observation that the belief {belief:?} allows, got {observed}"
)]
pub struct ZeroEvidence {
    /// The first such cell.
    pub cell: Cell,
    /// The value observed there.
    pub observed: u8,
    /// The belief about the cell, one probability per state.
    pub belief: Vec<f32>,
}

impl Filter {
    /// A filter with the predictor `u_0`.
    ///
    /// # Errors
    /// [`ModelError`] where the transition could divide by zero on the prior's grid.
    ///
    /// # Panics
    /// If the prior has another number of states than the model.
    pub fn new(model: &Model, prior: Belief) -> Result<Self, ModelError> {
        assert_eq!(
            prior.n_states(),
            model.n_states(),
            "prior: expected the model's states"
        );
        Ok(Self {
            transition: Transition::new(model, prior.shape())?,
            likelihood: model.likelihood().t().as_standard_layout().into_owned(),
            predictor: prior.view().to_owned(),
            belief: prior,
            posteriors: Vec::new(),
        })
    }

    /// The predictor `u_k`, or after [`Filter::correct`] the posterior `p_k`.
    pub fn belief(&self) -> &Belief {
        &self.belief
    }

    /// Believes something else of the same shape.
    ///
    /// # Panics
    /// If the shape is another.
    pub fn set_belief(&mut self, belief: Belief) {
        let dim = |belief: &Belief| belief.probabilities().dim();
        assert_eq!(dim(&belief), dim(&self.belief), "belief: another shape");
        self.belief = belief;
    }

    /// Bayes' rule on the visited cells, `p = B(y) u / (b(y)' u)` (eq. 5); `p = u` elsewhere.
    ///
    /// # Errors
    /// [`ZeroEvidence`] where `b(y)' u = 0`; the belief is then as it was.
    ///
    /// # Panics
    /// If the frame is of another grid or was decoded for more observations than the model has.
    pub fn correct(&mut self, frame: &Frame) -> Result<(), ZeroEvidence> {
        let shape = self.belief.shape();
        assert_eq!(
            frame.values().dim(),
            shape.dim(),
            "frame: expected the belief's grid"
        );
        let n_cells = shape.n_cells();
        self.posteriors.clear();
        for (index, observed) in frame.observed() {
            let prior = self.belief.as_slice()[index..].iter().step_by(n_cells);
            let likelihood = self.likelihood.row(usize::from(observed));
            // In f64, where the product of two f32 cannot underflow to zero.
            let joint = || {
                prior
                    .clone()
                    .zip(&likelihood)
                    .map(|(&u, b)| f64::from(u) * b)
            };
            let evidence: f64 = joint().sum();
            if evidence <= 0.0 {
                let belief = prior.copied().collect();
                let cell = shape.cell(index);
                return Err(ZeroEvidence {
                    cell,
                    observed,
                    belief,
                });
            }
            self.posteriors
                .extend(joint().map(|p| (p / evidence) as f32));
        }
        self.accept(frame);
        Ok(())
    }

    /// The predictor of the next step, `u_{k+1} = Phi(p_k)` (eq. 6).
    pub fn predict(&mut self) {
        let belief = self.belief.probabilities_mut();
        self.transition.apply(belief, &mut self.predictor);
        std::mem::swap(belief, &mut self.predictor);
    }

    /// Writes the posteriors of the frame's cells.
    fn accept(&mut self, frame: &Frame) {
        let n_states = self.belief.n_states();
        let n_cells = self.belief.shape().n_cells();
        let belief = self.belief.probabilities_mut();
        let belief = belief
            .as_slice_mut()
            .expect("invariant: beliefs are row-major");
        for ((index, _), posterior) in frame.observed().zip(self.posteriors.chunks_exact(n_states))
        {
            let cell = belief[index..].iter_mut().step_by(n_cells);
            cell.zip(posterior).for_each(|(to, &p)| *to = p);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::grid::Shape;

    fn frame(shape: Shape, values: &[u8]) -> Frame {
        Frame::from_bytes(shape, 3, values).expect("test frame")
    }

    #[test]
    fn correct_leaves_unseen_cells_unchanged() {
        let shape = Shape::new(1, 3).expect("test shape");
        let mut filter = Filter::new(&Model::wildfire(), Belief::uniform(3, shape)).expect("valid");
        filter
            .correct(&frame(shape, &[255, 2, 255]))
            .expect("possible");
        let fire = filter.belief().probability(2);
        assert_eq!([fire[[0, 0]], fire[[0, 2]]], [1.0 / 3.0; 2]);
        // .98 / (.01 + .05 + .98), the column of O for an observed fire.
        assert!((fire[[0, 1]] - 0.98 / 1.04).abs() < 1e-6);
    }

    #[test]
    fn an_impossible_frame_is_rejected_whole() {
        let mut file = Model::wildfire().file().clone();
        file.states[0].observed_as = vec![1.0, 0.0, 0.0];
        let model = Model::new(file).expect("valid model");
        let shape = Shape::new(2, 2).expect("test shape");
        let mut states = protocol::Grid::from_elem((2, 2), 2);
        states[[1, 0]] = 0;
        let prior = Belief::from_states(&states, 3).expect("valid states");
        let mut filter = Filter::new(&model, prior.clone()).expect("valid");
        // Cell 0 could be corrected, cell 2 is certainly normal and never looks like fire.
        let error = filter.correct(&frame(shape, &[1, 255, 2, 2]));
        let error = error.expect_err("a normal cell seen as fire");
        assert_eq!(error.cell, Cell { row: 1, col: 0 });
        assert_eq!(error.observed, 2);
        assert_eq!(filter.belief(), &prior);
    }

    #[test]
    fn a_tiny_probability_is_evidence() {
        let shape = Shape::new(1, 1).expect("test shape");
        let numbers = [1.0, 0.0, f32::MIN_POSITIVE];
        let numbers = Probabilities::from_shape_fn((3, 1, 1), |(state, _, _)| numbers[state]);
        let prior = Belief::from_probabilities(numbers).expect("valid");
        let mut file = Model::wildfire().file().clone();
        file.states[0].observed_as = vec![1.0, 0.0, 0.0];
        file.states[2].observed_as = vec![0.999, 0.0005, 0.0005];
        let mut filter = Filter::new(&Model::new(file).expect("valid"), prior).expect("valid");
        filter.correct(&frame(shape, &[2])).expect("possible");
        assert_eq!(filter.belief().probability(2)[[0, 0]], 1.0);
    }
}
