//! A Bayes filter whose corrections reach the neighbours of visited cells.
//!
//! The filter of eqs. 5 and 6 assumes that cells are independent given the frames, and corrects visited cells only. But
//! the states of nearby cells are strongly correlated. This filter spreads the innovation of each visited cell to its
//! neighbourhood by optimal interpolation (Gandin 1963), with learned [`Correlations`]. The prediction step is still
//! eq. 6, and no covariances are kept between steps.

use crate::estimation::bayes::ZeroEvidence;
use crate::estimation::belief::Belief;
use crate::estimation::correlations::{Ages, Correlations, Evidence};
use crate::estimation::estimator::{Estimator, EstimatorError, Filter, Handover, ObservationModel};
use crate::estimation::filter::BayesFilter;
use crate::estimation::innovation::Innovation;
use crate::estimation::spread::Spread;
use bincode::config::{Configuration, Fixint, Limit, LittleEndian};
use emberwatch_model::Frame;
use ndarray::Array2;
use std::borrow::Cow;

/// Encoding of ages and correlations. The size limit is above the encoded size for the largest grid.
const FORM: Configuration<LittleEndian, Fixint, Limit<{ 1 << 25 }>> = bincode::config::standard()
    .with_fixed_int_encoding()
    .with_limit();

/// The filter of one world, with corrections that reach the neighbours of visited cells.
#[derive(Debug, Clone)]
pub struct SpatialFilter {
    filter: BayesFilter,
    state: usize,
    correlations: Correlations,
    ages: Ages,
    spread: Spread,
}

/// Wraps a filter in a [`SpatialFilter`] if a state and its correlations are given.
pub fn correcting(
    filter: BayesFilter,
    neighbours: Option<(usize, Correlations)>,
) -> Box<dyn Filter> {
    match neighbours {
        Some((state, correlations)) => Box::new(SpatialFilter::new(filter, state, correlations)),
        None => Box::new(filter),
    }
}

impl SpatialFilter {
    /// Wraps a filter. Corrections to the probability of `state` (the *paying state*, which has the highest reward) are
    /// spread to neighbours.
    ///
    /// Each frame updates `correlations`. With the default, different cells are uncorrelated at first.
    ///
    /// # Panics
    /// If the filter has no such state.
    pub fn new(filter: BayesFilter, state: usize, correlations: Correlations) -> Self {
        let n_states = filter.belief().n_states();
        assert!(state < n_states, "state: expected less than {n_states}");
        Self {
            state,
            correlations,
            ages: Ages::new(filter.belief().shape().n_cells()),
            spread: Spread::new(filter.belief().shape(), state),
            filter,
        }
    }

    /// Returns the learned correlations between cells.
    pub fn correlations(&self) -> &Correlations {
        &self.correlations
    }

    /// Replaces the learned correlations between cells.
    pub fn set_correlations(&mut self, correlations: Correlations) {
        self.correlations = correlations;
    }

    /// Corrects the belief with observations of distinct cells, in the given order. Each item of `seen` is a cell's
    /// row-major index and its observation.
    ///
    /// # Errors
    /// If an observation is impossible under the belief. The belief is then unchanged.
    pub fn correct_in_order(
        &mut self,
        seen: impl Iterator<Item = (usize, u8)>,
    ) -> Result<(), ZeroEvidence> {
        let (belief, likelihood) = self.filter.parts();
        self.spread
            .start(belief, &self.ages, seen, &self.correlations);
        for index in 0..self.spread.n_seen() {
            let (cell, observed, mut states) = self.spread.prior(index, belief);
            let innovation = Innovation::of(&states, likelihood, self.state, observed);
            let innovation = innovation.ok_or_else(|| ZeroEvidence {
                cell,
                observed,
                belief: states.iter().map(|&p| p as f32).collect(),
            })?;
            let seen_as = likelihood.column(usize::from(observed));
            let all = states.iter_mut().zip(seen_as);
            all.for_each(|(p, b)| *p *= b / innovation.evidence);
            self.spread.spread(index, &innovation, states);
        }
        self.spread.end(self.filter.belief_mut(), &mut self.ages);
        self.filter.correct_cavities();
        Ok(())
    }
}

impl Estimator for SpatialFilter {
    fn correct(&mut self, frame: &Frame) -> Result<(), EstimatorError> {
        let (dim, expected) = (frame.values().dim(), self.belief().shape().dim());
        assert_eq!(dim, expected, "frame: expected the belief's grid");
        let (belief, likelihood) = self.filter.parts();
        let evidence = Evidence::of(frame, belief, likelihood, self.state, &self.ages);
        self.correct_in_order(frame.observed())?;
        self.correlations.learn(&evidence);
        Ok(())
    }

    fn predict(&mut self) {
        self.filter.predict();
        self.ages.grow();
    }

    fn belief(&self) -> &Belief {
        self.filter.belief()
    }
}

impl ObservationModel for SpatialFilter {
    fn likelihood(&self) -> Option<Cow<'_, Array2<f64>>> {
        self.filter.likelihood()
    }
}

impl Handover for SpatialFilter {
    fn kind(&self) -> String {
        let (filter, state) = (self.filter.kind(), self.state);
        format!("spatial {filter}, ages and sums of state {state} as bincode")
    }

    fn to_bytes(&self) -> Vec<u8> {
        let own = bincode::serde::encode_to_vec((&self.ages, &self.correlations), FORM);
        let own = own.expect("invariant: numbers can be encoded");
        [self.filter.to_bytes(), own].concat()
    }

    fn restore(&mut self, bytes: &[u8]) -> bool {
        let Some((belief, own)) = bytes.split_at_checked(self.filter.n_bytes()) else {
            return false;
        };
        let decoded = bincode::serde::decode_from_slice::<(Ages, Correlations), _>(own, FORM);
        let Ok(((ages, correlations), n_read)) = decoded else {
            return false;
        };
        let fits = n_read == own.len() && ages.as_slice().len() == self.ages.as_slice().len();
        let is_restored = fits && self.filter.restore(belief);
        if is_restored {
            (self.ages, self.correlations) = (ages, correlations);
        }
        is_restored
    }
}

#[cfg(test)]
mod tests;
