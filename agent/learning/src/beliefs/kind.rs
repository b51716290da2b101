//! What a kind of belief is, and what there is to build one from.

use super::world_form::WorldForm;
use crate::learned::Learned;
use anyhow::{Context, Result};
use emberwatch_belief::estimation::Estimator;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_model::{Model, Shape};
use std::fmt;

/// A kind of belief.
pub struct BeliefKind {
    /// Its name in policies, such as `known+spatial`.
    pub name: &'static str,
    /// Its name in files, settings and views, such as `spatial_filter`.
    pub label: &'static str,
    /// What it is, in a few words.
    pub about: &'static str,
    pub input: Input,
    /// Whether it predicts with the true model.
    pub knows_model: bool,
    /// What it was learned by, if it was.
    pub learned_by: Option<LearnedBy>,
    /// The legend of its policies in charts, and their colour: red, green, blue.
    pub chart: (&'static str, [u8; 3]),
    /// Of a kind that knows the model: names the beliefs that agents of this kind leave to each other.
    pub handover: Option<fn(&Model) -> String>,
    /// Makes one before its first frame.
    pub build: fn(&Conditions<'_>) -> Result<Box<dyn Estimator>>,
}

/// What changes a belief besides the prediction.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Input {
    Nothing,
    Frames,
    /// The hidden states X_k: an oracle.
    States,
    /// The hidden states X_{k+1} that the next path meets: a clairvoyant.
    NextStates,
}

/// What a belief was learned by.
pub struct LearnedBy {
    /// The learner: `train --learner NAME`.
    pub learner: &'static str,
    /// Whether that learns what to plan for, too (paper Algorithm 1).
    pub decides: bool,
    /// What that learned, if it was read from a checkpoint.
    pub find: fn(&Learned) -> Option<&dyn LearnedBelief>,
}

/// What a learner left in a checkpoint for a kind of belief.
pub trait LearnedBelief {
    /// The state that pays most, as its learner found it.
    fn target(&self) -> usize;

    /// States of the belief; they have numbers, not the names of the model's.
    fn n_states(&self) -> usize;

    /// Refuses worlds of another form than those that it was learned in.
    fn check_world(&self, world: &WorldForm) -> Result<()>;
}

/// What a belief is about, and what there is to build it from.
#[derive(Debug, Clone, Copy)]
pub struct Conditions<'a> {
    pub shape: Shape,
    /// The model, for filters and predictions, where it is known.
    pub model: Option<&'a Model>,
    /// The first belief of kinds that are about the model's states.
    pub prior: Option<&'a Belief>,
    pub learned: &'a Learned,
}

impl<'a> Conditions<'a> {
    /// The model.
    ///
    /// # Errors
    /// If it is not known.
    pub fn model(&self) -> Result<&'a Model> {
        self.model.context("model: expected one, got none")
    }

    /// The first belief.
    ///
    /// # Errors
    /// If there is none.
    pub fn prior(&self) -> Result<Belief> {
        let prior = self.prior.cloned();
        prior.context("prior: expected a first belief, got none")
    }
}

impl BeliefKind {
    /// Whether what to plan for was learned with it (paper Algorithm 1).
    pub fn decides(&self) -> bool {
        self.learned_by.as_ref().is_some_and(|by| by.decides)
    }

    /// What was learned for it; `None` if nothing has to be.
    ///
    /// # Errors
    /// If it has to, and no checkpoint holds it.
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

    /// Refuses worlds in which it cannot be built, from settings and checkpoints alone.
    ///
    /// # Errors
    /// If what it needs was not learned, or in worlds of another form.
    pub fn check(&self, learned: &Learned, world: &WorldForm) -> Result<()> {
        let learned = self.learned(learned)?;
        learned.map_or(Ok(()), |learned| learned.check_world(world))
    }

    /// The names of the states that it is about.
    ///
    /// # Errors
    /// If there is neither a model nor what was learned.
    pub fn state_names(&self, conditions: &Conditions<'_>) -> Result<Vec<String>> {
        Ok(match self.learned(conditions.learned)? {
            Some(learned) => numbered_states(learned.n_states()),
            None => conditions.model()?.state_names(),
        })
    }

    /// The state that pays most, among its own.
    ///
    /// # Errors
    /// As [`Self::state_names`].
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

/// Names of states that were learned.
pub fn numbered_states(n_states: usize) -> Vec<String> {
    let states = 0..n_states;
    states.map(|state| format!("state {state}")).collect()
}
