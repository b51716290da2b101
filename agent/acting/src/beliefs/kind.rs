//! Kinds of belief, and the inputs of their constructors.

use super::world_form::WorldForm;
use crate::learned::Learned;
use anyhow::{Context, Result};
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::{Estimator, Filter, Handover, ObservationModel, Told};
use emberwatch_model::{Model, Shape};
use std::any::Any;
use std::fmt;

/// A kind of belief: its constructor, names and properties.
pub struct BeliefKind {
    /// Name in policies, files, settings and views, such as `known+spatial`.
    pub name: &'static str,
    /// Short description.
    pub about: &'static str,
    pub input: Input,
    /// Whether it uses the true model.
    pub knows_model: bool,
    /// Whether a DQN can learn to choose options on it.
    pub has_options: bool,
    /// Whether the belief is about each cell's next observation instead of its state.
    pub is_of_observations: bool,
    /// Whether a single estimator divides its work among threads.
    pub is_parallel: bool,
    /// The learner of this kind. `None` if nothing is learned.
    pub learned_by: Option<LearnedBy>,
    /// Legend text and colour (red, green, blue) of its policies in charts.
    pub chart: (&'static str, [u8; 3]),
    /// The optional traits of its estimators.
    pub traits: Traits,
    /// Builds an estimator before its first frame.
    pub build: fn(&Conditions<'_>) -> Result<Box<dyn Estimator>>,
}

/// The optional traits of a kind's estimators. Each function takes an estimator of this kind.
#[derive(Clone, Copy)]
pub struct Traits {
    pub observation_model: Option<fn(&dyn Estimator) -> &dyn ObservationModel>,
    /// How agents hand a belief over, and Python copies and saves it.
    pub handover: Option<fn(&dyn Estimator) -> &dyn Handover>,
    pub handover_mut: Option<fn(&mut dyn Estimator) -> &mut dyn Handover>,
    /// For kinds that receive the hidden states.
    pub told: Option<fn(&mut dyn Estimator) -> &mut dyn Told>,
    /// Predicts several estimators of this kind together, with the same results as alone, if this is faster.
    pub predict_together: Option<fn(Vec<&mut dyn Estimator>)>,
}

impl Traits {
    pub const NONE: Self = Self {
        observation_model: None,
        handover: None,
        handover_mut: None,
        told: None,
        predict_together: None,
    };

    /// Returns the optional traits of a filter.
    pub const fn of_filter<E: Filter>() -> Self {
        Self {
            observation_model: Some(|it| cast::<E>(it)),
            handover: Some(|it| cast::<E>(it)),
            handover_mut: Some(|it| cast_mut::<E>(it)),
            ..Self::NONE
        }
    }
}

/// Returns an estimator as its own type.
///
/// # Panics
/// If it has another type.
pub fn cast<E: Estimator>(estimator: &dyn Estimator) -> &E {
    let own = (estimator as &dyn Any).downcast_ref();
    own.expect("invariant: the kind builds estimators of this type")
}

/// As [`cast`].
pub fn cast_mut<E: Estimator>(estimator: &mut dyn Estimator) -> &mut E {
    let own = (estimator as &mut dyn Any).downcast_mut();
    own.expect("invariant: the kind builds estimators of this type")
}

/// The data that correct a belief.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Input {
    Nothing,
    Frames,
    /// The hidden states X_k, for oracles.
    States,
}

/// The learner of a kind of belief.
pub struct LearnedBy {
    /// Name, as in `train --learner NAME`.
    pub learner: &'static str,
    /// Whether this learner also learns which objective to plan for (paper Algorithm 1).
    pub decides: bool,
    /// Finds the learned model among the values from checkpoints.
    pub find: fn(&Learned) -> Option<&dyn LearnedBelief>,
}

/// A learned model for a kind of belief, from a checkpoint.
pub trait LearnedBelief {
    /// Returns the kind that the learner trains for.
    fn kind(&self) -> &'static BeliefKind;

    /// Returns the state with the highest estimated reward.
    fn target(&self) -> usize;

    /// Returns the number of the belief's states. Learned states have numbers instead of names.
    fn n_states(&self) -> usize;

    /// Checks that a world has the form of the worlds in which the model was learned.
    fn check_world(&self, world: &WorldForm) -> Result<()>;
}

/// The inputs from which a belief is built.
#[derive(Clone, Copy)]
pub struct Conditions<'a> {
    pub shape: Shape,
    /// The true model, if it is known.
    pub model: Option<&'a Model>,
    /// The first belief, for kinds that use the model's states.
    pub prior: Option<&'a Belief>,
    pub learned: &'a Learned,
}

impl<'a> Conditions<'a> {
    /// Returns the model.
    ///
    /// # Errors
    /// If the model is unknown.
    pub fn model(&self) -> Result<&'a Model> {
        self.model.context("model: expected a model, got none")
    }

    /// Returns the first belief.
    ///
    /// # Errors
    /// If there is no first belief.
    pub fn prior(&self) -> Result<Belief> {
        let prior = self.prior.cloned();
        prior.context("prior: expected a first belief, got none")
    }
}

impl BeliefKind {
    /// Whether its learner also learns which objective to plan for (paper Algorithm 1).
    pub fn decides(&self) -> bool {
        self.learned_by.as_ref().is_some_and(|by| by.decides)
    }

    /// Returns the learned model, or `None` if this kind does not use one.
    ///
    /// # Errors
    /// If this kind needs a learned model and no checkpoint contains it.
    pub fn learned<'a>(&self, learned: &'a Learned) -> Result<Option<&'a dyn LearnedBelief>> {
        let Some(by) = &self.learned_by else {
            return Ok(None);
        };
        let found = (by.find)(learned);
        found.map(Some).with_context(|| {
            format!(
                "expected a checkpoint of `train --learner {}`, got none",
                by.learner
            )
        })
    }

    /// Checks that the belief can be built for worlds of the given form with the given checkpoints.
    ///
    /// # Errors
    /// If the learned model is missing, or was learned in worlds of another form.
    pub fn check(&self, learned: &Learned, world: &WorldForm) -> Result<()> {
        let learned = self.learned(learned)?;
        learned.map_or(Ok(()), |learned| learned.check_world(world))
    }

    /// Returns the names of the belief's states.
    ///
    /// # Errors
    /// If both the model and a learned model are missing.
    pub fn state_names(&self, conditions: &Conditions<'_>) -> Result<Vec<String>> {
        Ok(match self.learned(conditions.learned)? {
            Some(learned) => numbered_states(learned.n_states()),
            None => conditions.model()?.state_names(),
        })
    }

    /// Returns the index, in the belief, of the state with the highest reward.
    ///
    /// # Errors
    /// Under the same conditions as [`Self::state_names`].
    pub fn target(&self, conditions: &Conditions<'_>) -> Result<usize> {
        Ok(match self.learned(conditions.learned)? {
            Some(learned) => learned.target(),
            None => conditions.model()?.target_state(),
        })
    }
}

impl PartialEq for BeliefKind {
    fn eq(&self, other: &Self) -> bool {
        self.name == other.name
    }
}

impl fmt::Debug for BeliefKind {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.name)
    }
}

/// Returns names for learned states, such as `state 0`.
pub fn numbered_states(n_states: usize) -> Vec<String> {
    let states = 0..n_states;
    states.map(|state| format!("state {state}")).collect()
}
