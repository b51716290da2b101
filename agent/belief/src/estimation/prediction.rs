//! The prediction of one world's next states from the belief about its current ones (eq. 6).
//!
//! The filter assumes that cells are independent. A model with the paper's rule is predicted by eqs. 2 and 3, applied to
//! the neighbours' mean weights. A model of hazards is predicted exactly under the assumption.

mod hazards;
mod lanes;
mod padded;
mod planes;

use crate::estimation::belief::Belief;
use crate::estimation::parameters::Tables;
use emberwatch_model::{Model, ModelError, Probabilities, Rule, Transition};
use hazards::HazardPrediction;

/// The prediction of one world, with its buffers.
#[derive(Debug, Clone)]
pub struct Prediction(Kind);

#[derive(Debug, Clone)]
enum Kind {
    Ratio {
        transition: Transition,
        predictor: Probabilities,
    },
    Hazards(HazardPrediction),
}

impl Prediction {
    /// Prepares the predictions of a known model on the belief's grid. With `cavities`, a model of hazards is predicted
    /// without the influence of each cell on itself through its neighbours; other models have no cavities.
    ///
    /// # Errors
    /// If eq. 3 could divide by zero on the grid, or a map of the model has a different grid.
    ///
    /// # Panics
    /// If the belief and the model have different numbers of states.
    pub fn known(model: &Model, belief: &Belief, cavities: bool) -> Result<Self, ModelError> {
        let expected = model.n_states();
        assert_eq!(
            belief.n_states(),
            expected,
            "belief: expected the model's number of states"
        );
        model.check_on(belief.shape())?;
        Ok(Self(match model.rule() {
            Rule::Ratio(ratio) => {
                let bias = ratio.bias().to_vec();
                let transition =
                    Transition::new(ratio.kernel(), &bias, model.edge(), belief.shape());
                Kind::ratio(transition, belief)
            }
            Rule::Hazards(hazards) => {
                let edge = model.edge();
                Kind::Hazards(HazardPrediction::new(hazards, edge, belief, cavities))
            }
        }))
    }

    /// Prepares the predictions of learned parameters on the belief's grid.
    ///
    /// # Panics
    /// If the belief and the parameters have different numbers of states.
    pub fn learned(tables: &Tables, belief: &Belief) -> Self {
        let n_states = tables.dimensions.n_states;
        assert_eq!(
            belief.n_states(),
            n_states,
            "belief: expected the parameters' number of states"
        );
        let (kernel, bias) = (tables.kernel_array(), vec![0.0; n_states]);
        let transition = Transition::new(&kernel, &bias, None, belief.shape());
        Self(Kind::ratio(transition, belief))
    }

    /// Returns whether there are cavities, which [`Self::correct`] must then update after each correction.
    pub fn has_cavities(&self) -> bool {
        self.n_bytes() > 0
    }

    /// Returns the number of bytes of [`Self::to_bytes`].
    pub fn n_bytes(&self) -> usize {
        match &self.0 {
            Kind::Ratio { .. } => 0,
            Kind::Hazards(hazards) => hazards.beliefs.n_bytes(),
        }
    }

    /// Returns the cavities, each `[S, H, W]`, row-major, as little-endian `f32`; empty if there are none.
    pub fn to_bytes(&self) -> Vec<u8> {
        match &self.0 {
            Kind::Ratio { .. } => Vec::new(),
            Kind::Hazards(hazards) => hazards.beliefs.cavities_to_bytes(),
        }
    }

    /// Loads the cavities from the bytes of a prediction with the same model and grid.
    ///
    /// Returns false and changes nothing if the length differs, or if [`Belief::from_bytes`] rejects a cavity.
    pub fn restore(&mut self, bytes: &[u8]) -> bool {
        match &mut self.0 {
            Kind::Ratio { .. } => bytes.is_empty(),
            Kind::Hazards(hazards) => hazards.beliefs.restore_cavities(bytes),
        }
    }

    /// Updates the cavities with a correction that changed the belief from `before` to `after`, both `[S, H, W]`.
    pub fn correct(&mut self, before: &[f32], after: &[f32]) {
        if let Kind::Hazards(hazards) = &mut self.0 {
            hazards.beliefs.correct_cavities(before, after);
        }
    }

    /// Moves the belief one step ahead, and the cavities with it.
    ///
    /// # Panics
    /// If the belief has a different grid or number of states.
    pub fn predict(&mut self, belief: &mut Belief) {
        match &mut self.0 {
            Kind::Ratio {
                transition,
                predictor,
            } => {
                let belief = belief.probabilities_mut();
                transition.apply(belief, predictor);
                std::mem::swap(belief, predictor);
            }
            Kind::Hazards(hazards) => hazards.predict(belief.as_mut_slice()),
        }
    }
}

impl Kind {
    fn ratio(transition: Transition, belief: &Belief) -> Self {
        Self::Ratio {
            transition,
            predictor: belief.probabilities().clone(),
        }
    }
}

#[cfg(test)]
mod tests;
