//! The Bayes filter, for known and learned parameters (paper section III.A, in the masked form of section III.C).
//!
//! A frame turns the predictor `u_k` into the posterior `p_k` (eq. 5); the transition model turns the posterior into
//! the next predictor `u_{k+1} = Phi(p_k)` (eq. 6). Cells are treated as independent given the frames, so the filter is
//! an approximation even with the true model.

use crate::estimation::bayes::correct;
use crate::estimation::belief::Belief;
use crate::estimation::estimator::{Estimator, EstimatorError, Handover, ObservationModel};
use crate::estimation::parameters::Tables;
use crate::estimation::prediction::Prediction;
use emberwatch_model::frame::Frame;
use emberwatch_model::{Model, ModelError, Rule};
use ndarray::Array2;
use std::borrow::Cow;

/// The Bayes filter of one world.
#[derive(Debug, Clone)]
pub struct BayesFilter {
    prediction: Prediction,
    /// `P(y | x)`, shape `[S, O]`.
    likelihood: Array2<f64>,
    belief: Belief,
    /// With cavities, the belief after the last prediction or correction, with which the next correction is compared.
    before: Vec<f32>,
    /// Checksum of the parameters. A saved belief fits only a filter with the same parameters.
    checksum: u32,
}

impl BayesFilter {
    /// Creates the filter of a known model, with `prior` as the predictor `u_0`. With `cavities`, a model of hazards is
    /// predicted without the influence of each cell on itself through its neighbours.
    ///
    /// # Errors
    /// If eq. 3 could divide by zero on the prior's grid, or a map of the model has a different grid.
    ///
    /// # Panics
    /// If the prior and the model have different numbers of states.
    pub fn known(model: &Model, prior: Belief, cavities: bool) -> Result<Self, ModelError> {
        let prediction = Prediction::known(model, &prior, cavities)?;
        let likelihood = model.likelihood().clone();
        Ok(Self::new(
            prediction,
            likelihood,
            prior,
            known_checksum(model),
        ))
    }

    /// Creates a filter with learned parameters, and `prior` as the predictor `u_0`.
    ///
    /// # Panics
    /// If the prior and the parameters have different numbers of states.
    pub fn learned(tables: &Tables, prior: Belief) -> Self {
        let prediction = Prediction::learned(tables, &prior);
        let likelihood = tables.likelihood_array();
        let checksum = checksum(tables.kernel_array().into_iter(), &likelihood);
        Self::new(prediction, likelihood, prior, checksum)
    }

    fn new(prediction: Prediction, likelihood: Array2<f64>, belief: Belief, checksum: u32) -> Self {
        let before = prediction
            .has_cavities()
            .then(|| belief.as_slice().to_vec());
        Self {
            before: before.unwrap_or_default(),
            prediction,
            likelihood,
            belief,
            checksum,
        }
    }

    pub(super) fn correct_cavities(&mut self) {
        if self.prediction.has_cavities() {
            self.prediction
                .correct(&self.before, self.belief.as_slice());
            // A second correction in the same step starts from this belief.
            self.before.copy_from_slice(self.belief.as_slice());
        }
    }

    pub(super) fn n_bytes(&self) -> usize {
        4 * self.belief.as_slice().len() + self.prediction.n_bytes()
    }

    pub(super) fn parts(&self) -> (&Belief, &Array2<f64>) {
        (&self.belief, &self.likelihood)
    }

    pub(super) fn belief_mut(&mut self) -> &mut Belief {
        &mut self.belief
    }
}

impl Estimator for BayesFilter {
    fn correct(&mut self, frame: &Frame) -> Result<(), EstimatorError> {
        correct(&mut self.belief, &self.likelihood, frame)?;
        self.correct_cavities();
        Ok(())
    }

    fn predict(&mut self) {
        self.prediction.predict(&mut self.belief);
        if self.prediction.has_cavities() {
            self.before.copy_from_slice(self.belief.as_slice());
        }
    }

    /// Returns the predictor `u_k` before [`Estimator::correct`], and the posterior `p_k` after it.
    fn belief(&self) -> &Belief {
        &self.belief
    }
}

impl ObservationModel for BayesFilter {
    fn likelihood(&self) -> Option<Cow<'_, Array2<f64>>> {
        Some(Cow::Borrowed(&self.likelihood))
    }
}

impl Handover for BayesFilter {
    fn kind(&self) -> String {
        let has_cavities = self.prediction.has_cavities();
        let cavities = if has_cavities { " with cavities" } else { "" };
        let checksum = self.checksum;
        format!("bayes_filter{cavities} {checksum:08x}, probabilities [S, H, W] as f32")
    }

    fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = self.belief.to_bytes();
        bytes.extend(self.prediction.to_bytes());
        bytes
    }

    fn restore(&mut self, bytes: &[u8]) -> bool {
        let Some((belief, rest)) = bytes.split_at_checked(4 * self.belief.as_slice().len()) else {
            return false;
        };
        let belief = Belief::from_bytes(belief, self.belief.probabilities().dim());
        let Some(belief) = belief.filter(|_| self.prediction.restore(rest)) else {
            return false;
        };
        self.belief = belief;
        if self.prediction.has_cavities() {
            self.before.copy_from_slice(self.belief.as_slice());
        }
        true
    }
}

fn known_checksum(model: &Model) -> u32 {
    let edge = model.edge().map(|edge| edge as f64);
    let numbers: Vec<f64> = match model.rule() {
        Rule::Ratio(ratio) => ratio.kernel().iter().chain(ratio.bias()).copied().collect(),
        Rule::Hazards(hazards) => hazards.numbers(),
    };
    checksum(numbers.into_iter().chain(edge), model.likelihood())
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
            BayesFilter::known(&model, prior, true).expect("valid model")
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
}
