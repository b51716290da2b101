//! The source of the beliefs that decisions are based on.

use crate::learners::base::LearnerInputs;
use anyhow::{Context, Result};
use emberwatch_acting::beliefs::first_belief::first_belief;
use emberwatch_acting::beliefs::{self, BeliefKind, Conditions};
use emberwatch_acting::learned::Learned;
use emberwatch_belief::estimation::Estimator;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_model::{Model, Shape};

/// Finds the belief that decisions are based on, given the setting `decisions.estimator`.
///
/// # Errors
/// If there is no such belief. The error lists all valid names.
pub fn belief_of(name: &str) -> Result<&'static BeliefKind> {
    let kind = beliefs::of_options(name);
    kind.map_err(|problem| anyhow::anyhow!("decisions.estimator: {problem}"))
}

/// A kind of belief with everything needed to build it.
pub struct Base {
    pub kind: &'static BeliefKind,
    shape: Shape,
    known: Option<(Model, Belief)>,
    pub(super) learned: Learned,
    pub(super) target: usize,
    pub(super) state_names: Vec<String>,
}

impl Base {
    /// Creates the base for a kind of belief. `known` is the model and the first belief, for kinds that know the model.
    ///
    /// # Errors
    /// If the model or the learned value that the kind uses is missing.
    pub fn new(
        kind: &'static BeliefKind,
        known: Option<(Model, Belief)>,
        learned: Learned,
        shape: Shape,
    ) -> Result<Self> {
        let mut base = Self {
            kind,
            shape,
            known,
            learned,
            target: 0,
            state_names: Vec::new(),
        };
        base.target = kind.target(&base.conditions())?;
        base.state_names = kind.state_names(&base.conditions())?;
        Ok(base)
    }

    pub(super) fn of_settings(on: &LearnerInputs<'_>) -> Result<Self> {
        let (config, shape) = (on.config, on.worlds.shape());
        let kind = belief_of(&config.decisions.estimator)?;
        let mut known = None;
        if kind.knows_model {
            let model = on.info.model.as_deref().with_context(|| {
                format!(
                    "decisions on the belief {} need the server's model: start it with --reveal-model true and without \
                     --states",
                    kind.name
                )
            })?;
            let model = Model::from_toml(model)?;
            let prior = config.prior(on.info.burn_in);
            let prior = first_belief(prior, &model, shape, config.seed)?;
            known = Some((model, prior));
        }
        Self::new(kind, known, on.learned.clone(), shape)
    }

    fn conditions(&self) -> Conditions<'_> {
        let known = self.known.as_ref();
        Conditions {
            shape: self.shape,
            model: known.map(|(model, _)| model),
            prior: known.map(|(_, prior)| prior),
            learned: &self.learned,
        }
    }

    pub(super) fn estimator(&self) -> Result<Box<dyn Estimator>> {
        (self.kind.build)(&self.conditions())
    }
}
