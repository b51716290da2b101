//! The Bayes filter, for known and learned parameters (paper section III.A, in the masked form of section III.C).
//!
//! A frame turns the predictor `u_k` into the posterior `p_k` (eq. 5); the transition model turns the posterior into
//! the next predictor `u_{k+1} = Phi(p_k)` (eq. 6). Cells are treated as independent given the frames, so the filter is
//! an approximation even with the true model.

use crate::estimation::bayes::correct;
use crate::estimation::belief::Belief;
use crate::estimation::estimator::{Estimator, EstimatorError, Handover};
use crate::estimation::parameters::Tables;
use crate::estimation::prediction::{Prediction, PredictionKind, Weights};
use emberwatch_model::frame::Frame;
use emberwatch_model::grid::Probabilities;
use emberwatch_model::transition::Transition;
use emberwatch_model::{Model, ModelError};
use ndarray::Array2;
use std::borrow::Cow;

/// The Bayes filter of one world.
#[derive(Debug, Clone)]
pub struct BayesFilter {
    transition: Transition,
    /// The predictor to use instead of `transition`, or `None` for the mean field.
    prediction: Option<Prediction>,
    /// `P(y | x)`, shape `[S, O]`.
    likelihood: Array2<f64>,
    belief: Belief,
    /// Buffer for the next predictor. With cavities, it keeps a copy of the belief between predictions, because the
    /// next correction of the cavities needs the belief before the correction.
    predictor: Probabilities,
    /// Checksum of the parameters. A saved belief fits only a filter with the same parameters.
    checksum: u32,
}

impl BayesFilter {
    /// Creates the filter of a known model, with `prior` as the predictor `u_0`. The filter predicts with the mean
    /// field.
    ///
    /// # Errors
    /// If eq. 3 could divide by zero on the prior's grid, or a map of the model has a different grid.
    ///
    /// # Panics
    /// If the prior and the model have different numbers of states.
    pub fn known(model: &Model, prior: Belief) -> Result<Self, ModelError> {
        let expected = model.n_states();
        assert_eq!(
            prior.n_states(),
            expected,
            "prior: expected the model's number of states"
        );
        let transition = Transition::new(model, prior.shape())?;
        let checksum = known_checksum(model);
        let likelihood = model.likelihood().clone();
        Ok(Self::new(transition, likelihood, prior, checksum))
    }

    /// Creates a filter with learned parameters, and `prior` as the predictor `u_0`. The filter predicts with the mean
    /// field.
    ///
    /// # Panics
    /// If the prior and the parameters have different numbers of states.
    pub fn learned(tables: &Tables, prior: Belief) -> Self {
        let (transition, likelihood, checksum) = parameters(tables, &prior);
        Self::new(transition, likelihood, prior, checksum)
    }

    /// Sets the kind of prediction of a filter with learned parameters. `tables` must be the filter's parameters.
    pub fn predicting_learned(self, tables: &Tables, kind: PredictionKind) -> Self {
        let weights = Weights {
            kernels: &tables.kernels(),
            bias: &vec![0.0; tables.dimensions.n_states],
            zones: (None, 1),
            edge: None,
        };
        self.predicting(weights, kind)
    }

    fn new(transition: Transition, likelihood: Array2<f64>, belief: Belief, checksum: u32) -> Self {
        Self {
            transition,
            prediction: None,
            likelihood,
            predictor: belief.probabilities().clone(),
            belief,
            checksum,
        }
    }

    /// Sets the kind of prediction of a known model's filter. `model` must be the filter's model.
    pub fn predicting_known(self, model: &Model, kind: PredictionKind) -> Self {
        self.predicting(model.into(), kind)
    }

    fn predicting(mut self, weights: Weights<'_>, kind: PredictionKind) -> Self {
        if kind != PredictionKind::MeanField {
            self.prediction = Some(Prediction::new(weights, kind, &self.belief));
        }
        self
    }

    /// Updates the cavities after a correction of the belief.
    pub(super) fn correct_cavities(&mut self) {
        if let Some(prediction) = &mut self.prediction {
            let before = self.predictor.as_slice().expect("invariant: row-major");
            prediction.correct(before, self.belief.as_slice());
            if prediction.has_cavities() {
                // A second correction in the same step starts from this belief.
                self.predictor.assign(self.belief.probabilities());
            }
        }
    }

    /// Returns the [`Handover::kind`] of filters of a known model.
    pub fn handover_of_known(model: &Model, kind: PredictionKind) -> String {
        handover_of(known_checksum(model), kind)
    }

    /// Returns the number of bytes of [`Handover::to_bytes`].
    pub(super) fn n_bytes(&self) -> usize {
        let cavities = self.prediction.as_ref().map_or(0, Prediction::n_bytes);
        4 * self.belief.as_slice().len() + cavities
    }

    /// Returns the belief and `P(y | x)`, shape `[S, O]`.
    pub(super) fn parts(&self) -> (&Belief, &Array2<f64>) {
        (&self.belief, &self.likelihood)
    }

    pub(super) fn belief_mut(&mut self) -> &mut Belief {
        &mut self.belief
    }
}

impl Estimator for BayesFilter {
    /// # Panics
    /// If the frame's grid differs from the belief's, or the model lacks one of the frame's observations.
    fn correct(&mut self, frame: &Frame) -> Result<(), EstimatorError> {
        correct(&mut self.belief, &self.likelihood, frame)?;
        self.correct_cavities();
        Ok(())
    }

    fn predict(&mut self) {
        if let Some(prediction) = &mut self.prediction {
            let predictor = self.predictor.as_slice_mut();
            let predictor = predictor.expect("invariant: row-major");
            prediction.predict(self.belief.as_slice(), predictor);
            // Both buffers contain the predictor, because the next correction of the cavities compares the belief with
            // it.
            self.belief.as_mut_slice().copy_from_slice(predictor);
            return;
        }
        let belief = self.belief.probabilities_mut();
        self.transition.apply(belief, &mut self.predictor);
        std::mem::swap(belief, &mut self.predictor);
    }

    fn memory_bytes(&self) -> usize {
        let prediction = self.prediction.as_ref();
        size_of::<Self>()
            + 2 * size_of_val(self.belief.as_slice())
            + self.transition.memory_bytes()
            + prediction.map_or(0, Prediction::memory_bytes)
    }

    /// Returns the predictor `u_k` before [`Estimator::correct`], and the posterior `p_k` after it.
    fn belief(&self) -> &Belief {
        &self.belief
    }

    fn likelihood(&self) -> Option<Cow<'_, Array2<f64>>> {
        Some(Cow::Borrowed(&self.likelihood))
    }

    fn handover(&self) -> Option<&dyn Handover> {
        Some(self)
    }

    fn handover_mut(&mut self) -> Option<&mut dyn Handover> {
        Some(self)
    }
}

impl Handover for BayesFilter {
    fn kind(&self) -> String {
        let kind = self.prediction.as_ref().map(Prediction::kind);
        handover_of(self.checksum, kind.unwrap_or_default())
    }

    fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = self.belief.to_bytes();
        bytes.extend(self.prediction.iter().flat_map(Prediction::to_bytes));
        bytes
    }

    fn restore(&mut self, bytes: &[u8]) -> bool {
        let Some((belief, rest)) = bytes.split_at_checked(4 * self.belief.as_slice().len()) else {
            return false;
        };
        let belief = Belief::from_bytes(belief, self.belief.probabilities().dim());
        let Some(belief) = belief else {
            return false;
        };
        let is_restored = match &mut self.prediction {
            Some(prediction) => prediction.restore(rest),
            None => rest.is_empty(),
        };
        if is_restored {
            self.predictor.assign(belief.probabilities());
            self.belief = belief;
        }
        is_restored
    }
}

fn handover_of(checksum: u32, kind: PredictionKind) -> String {
    let kind = match kind {
        PredictionKind::MeanField => "",
        PredictionKind::SecondOrder => " of second order",
        PredictionKind::Cavities => " with cavities",
    };
    format!("bayes_filter{kind} {checksum:08x}, probabilities [S, H, W] as f32")
}

fn known_checksum(model: &Model) -> u32 {
    let weights = model.kernels().iter().flatten();
    let edge = model.edge().map(|edge| edge as f64);
    let numbers = weights.chain(model.bias()).copied().chain(edge);
    checksum(numbers, model.likelihood())
}

fn parameters(tables: &Tables, belief: &Belief) -> (Transition, Array2<f64>, u32) {
    let dimensions = tables.dimensions;
    let n_states = dimensions.n_states;
    assert_eq!(
        belief.n_states(),
        n_states,
        "belief: expected the parameters' number of states"
    );
    let kernels = tables.kernels();
    let likelihood = tables.likelihood_array();
    let checksum = checksum(kernels.iter().flatten().copied(), &likelihood);
    let bias = vec![0.0; n_states];
    let transition = Transition::of_weights(&kernels, &bias, belief.shape());
    (transition, likelihood, checksum)
}

fn checksum(weights: impl Iterator<Item = f64>, likelihood: &Array2<f64>) -> u32 {
    let numbers = weights.chain(likelihood.iter().copied());
    let bytes: Vec<u8> = numbers.flat_map(f64::to_le_bytes).collect();
    crc32fast::hash(&bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberwatch_model::grid::Shape;

    #[test]
    fn correcting_in_two_parts_equals_one_correction() {
        let shape = Shape::new(3, 4).expect("test shape");
        let model = Model::built_in("wildfire-burnout").expect("built in");
        let filter = || {
            let prior = Belief::uniform(model.n_states(), shape);
            let filter = BayesFilter::known(&model, prior).expect("valid model");
            filter.predicting_known(&model, PredictionKind::Cavities)
        };
        let (mut whole, mut parts) = (filter(), filter());
        let mut values = [255; 12];
        (values[1], values[6]) = (1, 2);
        for _ in 0..3 {
            whole.correct(&frame(shape, &values)).expect("possible");
            for cell in [1, 6] {
                let mut part = [255; 12];
                part[cell] = values[cell];
                parts.correct(&frame(shape, &part)).expect("possible");
            }
            whole.predict();
            parts.predict();
        }
        let off = (&whole.belief().view() - &parts.belief().view()).mapv(f32::abs);
        assert!(off.iter().all(|off| *off < 1e-5), "{off}");
    }

    fn frame(shape: Shape, values: &[u8]) -> Frame {
        Frame::from_bytes(shape, 3, values).expect("test frame")
    }

    #[test]
    fn correct_leaves_unseen_cells_unchanged() {
        let shape = Shape::new(1, 3).expect("test shape");
        let mut filter =
            BayesFilter::known(&Model::wildfire(), Belief::uniform(3, shape)).expect("valid");
        filter
            .correct(&frame(shape, &[255, 2, 255]))
            .expect("possible");
        let fire = filter.belief().probability(2);
        assert_eq!([fire[[0, 0]], fire[[0, 2]]], [1.0 / 3.0; 2]);
        // The column of O for an observed fire is (.01, .05, .98), and the prior is uniform.
        assert!((fire[[0, 1]] - 0.98 / 1.04).abs() < 1e-6);
    }

    #[test]
    fn a_tiny_probability_does_not_count_as_zero() {
        let shape = Shape::new(1, 1).expect("test shape");
        let numbers = [1.0, 0.0, f32::MIN_POSITIVE];
        let numbers = Probabilities::from_shape_fn((3, 1, 1), |(state, _, _)| numbers[state]);
        let prior = Belief::from_probabilities(numbers).expect("valid");
        let mut file = Model::wildfire().file().clone();
        file.states[0].observed_as = vec![1.0, 0.0, 0.0];
        file.states[2].observed_as = vec![0.999, 0.0005, 0.0005];
        let mut filter =
            BayesFilter::known(&Model::new(file).expect("valid"), prior).expect("valid");
        filter.correct(&frame(shape, &[2])).expect("possible");
        assert_eq!(filter.belief().probability(2)[[0, 0]], 1.0);
    }
}
