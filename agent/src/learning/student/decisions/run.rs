//! A robot while decisions are learned, and what keeps the belief that it decides on.

use crate::estimation::{BayesFilter, Correlations, Estimator, SpatialFilter};
use crate::learning::learner::LearnedModel;
use crate::planning::options::N_FEATURES;
use crate::planning::policy::{EstimatorKind, numbered_states};
use crate::planning::{OPTIONS, Proposal};
use crate::rollout::Robot;
use ::network::{DqnShape, Track, Transition};
use protocol::{Model, Shape};
use serde::{Deserialize, Serialize};

/// What a decision is made on, and among.
pub const SHAPE: DqnShape = DqnShape {
    n_inputs: N_FEATURES,
    n_outputs: 1,
    n_candidates: OPTIONS.len(),
};

/// What keeps the beliefs that decisions are made on, before a world's first frame.
pub struct Base {
    pub kind: EstimatorKind,
    filter: BayesFilter,
    /// The state that pays most.
    pub target: usize,
    correlations: Correlations,
    pub state_names: Vec<String>,
    /// What the filter learned, unless the model is known.
    pub model: Option<LearnedModel>,
}

/// A robot at its world, and what is to be learned from its steps.
pub struct Run {
    pub robot: Robot,
    /// The features of the option flown last and its reward, until what follows is known.
    pub last: Option<(Vec<f32>, f32)>,
    pub track: Track,
    pub held: Held,
    /// What is flown next.
    pub next: Option<(usize, Proposal)>,
}

/// A random option that is flown for some steps in a row.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Held {
    pub option: usize,
    pub n_steps: u64,
}

impl Base {
    /// On a known model, whose filter is given.
    pub fn known(kind: EstimatorKind, filter: BayesFilter, model: &Model) -> Self {
        Self {
            kind,
            filter,
            target: model.target_state(),
            correlations: Correlations::default(),
            state_names: model.state_names(),
            model: None,
        }
    }

    pub fn learned(kind: EstimatorKind, model: LearnedModel, shape: Shape) -> Self {
        Self {
            kind,
            filter: BayesFilter::learned(&model.tables, model.tables.prior(shape)),
            target: model.target,
            correlations: model.correlations.clone(),
            state_names: numbered_states(model.tables.dimensions.n_states),
            model: Some(model),
        }
    }

    pub fn estimator(&self) -> Box<dyn Estimator> {
        let filter = self.filter.clone();
        if self.kind.is_spatial() {
            let correlations = self.correlations.clone();
            Box::new(SpatialFilter::new(filter, self.target, correlations))
        } else {
            Box::new(filter)
        }
    }
}

impl Run {
    pub fn propose(&mut self) -> Vec<Proposal> {
        let cell = self.robot.observation().robot.cell();
        self.robot.agent.propose(cell)
    }

    /// Takes in the features of what can be flown now; gives the transition that is complete by then.
    pub fn led_to(&mut self, features: &[f32]) -> Option<Transition> {
        let (input, reward) = self.last.take()?;
        self.track.add(Transition {
            input,
            action: 0,
            reward,
            next: features.to_vec(),
        })
    }
}
