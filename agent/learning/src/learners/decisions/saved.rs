//! Checkpoints of decisions: the DQN, and the belief that it was trained on.

use super::base::{Base, belief_of};
use crate::checkpoint::{Contents, check, check_counts};
use crate::models::{SavedModel, SavedNeuralModel, filter_tensors, neural_tensors};
use anyhow::{Context, Result, ensure};
use emberwatch_acting::beliefs::learned::LearnedModel;
use emberwatch_acting::beliefs::neural::NeuralModel;
use emberwatch_acting::beliefs::{BeliefKind, NEURAL};
use emberwatch_acting::learned::Learned;
use emberwatch_acting::policy::LearnedDecisions;
use emberwatch_belief::planning::OPTIONS;
use emberwatch_belief::planning::options::N_FEATURES;
use emberwatch_model::Shape;
use emberwatch_network::{Device, Dqn, DqnShape, NamedTensor};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// The shape of the DQN: features per option, and number of options.
pub const SHAPE: DqnShape = DqnShape::of_candidates(N_FEATURES, OPTIONS.len());

const NOTHING: &str = "decisions: expected a checkpoint of a learned belief, got none";

pub(super) const BELIEF: &str = "belief.";

/// A checkpoint of decisions, without its tensors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SavedDecisions {
    pub options: Vec<String>,
    /// The name of the belief that the decisions are based on.
    pub estimator: String,
    pub(super) belief: Option<SavedBelief>,
    pub n_updates: u64,
    pub world_steps: u64,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) enum SavedBelief {
    Filter(Box<SavedModel>),
    Neural(SavedNeuralModel),
}

impl SavedBelief {
    pub(super) fn of(
        kind: &BeliefKind,
        learned: &Learned,
    ) -> Result<Option<(Self, Vec<NamedTensor>)>> {
        let Some(by) = &kind.learned_by else {
            return Ok(None);
        };
        let (belief, tensors) = if by.learner == "neural" {
            let model = learned.get::<NeuralModel>().context(NOTHING)?;
            (
                Self::Neural(SavedNeuralModel::of(model)),
                neural_tensors(model)?,
            )
        } else {
            ensure!(
                by.learner == "filter",
                "decisions: expected a filter or a neural belief, got {}",
                kind.name
            );
            let model = learned.get::<LearnedModel>().context(NOTHING)?;
            (
                Self::Filter(Box::new(SavedModel::of(model))),
                filter_tensors(model).into(),
            )
        };
        let named = |(name, shape, numbers)| (format!("{BELIEF}{name}"), shape, numbers);
        Ok(Some((belief, tensors.into_iter().map(named).collect())))
    }
}

/// Returns whether it replaced different decisions.
pub(super) fn read(contents: &Contents, device: &Device, learned: &mut Learned) -> Result<bool> {
    let config = contents.settings()?;
    let saved: SavedDecisions = contents.state()?;
    let mut dqn = Dqn::new(config.decisions.settings(), SHAPE, config.seed);
    saved.load_into(&mut dqn, contents)?;
    let decisions = LearnedDecisions {
        scorer: Arc::new(dqn),
        belief: saved.kind()?,
        beam_width: config.decisions.beam_width,
    };
    ensure!(
        !saved.read_belief(contents, device, learned)?,
        "expected one belief of each kind, got two: the belief of the decisions, and another"
    );
    Ok(learned.put(decisions))
}

impl SavedDecisions {
    /// Returns the kind of belief that the decisions are based on.
    pub fn kind(&self) -> Result<&'static BeliefKind> {
        belief_of(&self.estimator)
    }

    /// Returns the belief that the decisions are based on, if it was learned. Networks compute on `device`.
    pub fn base(&self, contents: &Contents, shape: Shape, device: &Device) -> Result<Option<Base>> {
        let (kind, mut learned) = (self.kind()?, Learned::default());
        self.read_belief(contents, device, &mut learned)?;
        let is_learned = kind.learned_by.is_some();
        let base = is_learned.then(|| Base::new(kind, None, learned, shape));
        base.transpose()
    }

    /// Returns whether it replaced a different belief.
    pub(super) fn read_belief(
        &self,
        contents: &Contents,
        device: &Device,
        learned: &mut Learned,
    ) -> Result<bool> {
        let (kind, part) = (self.kind()?, contents.part(BELIEF));
        let is_neural = matches!(self.belief, Some(SavedBelief::Neural(_)));
        check(
            is_neural == (*kind == NEURAL),
            "belief",
            kind.name,
            "another",
        )?;
        Ok(match &self.belief {
            None => false,
            Some(SavedBelief::Filter(model)) => learned.put(model.read(&part)?),
            Some(SavedBelief::Neural(model)) => learned.put(model.read(&part, device)?),
        })
    }

    pub(super) fn load_into(&self, dqn: &mut Dqn, contents: &Contents) -> Result<()> {
        let expected = OPTIONS.map(|option| option.name).join(" ");
        let got = self.options.join(" ");
        check(got == expected, "options", &expected, &got)?;
        check_counts(&[
            ("n_updates", self.n_updates),
            ("world_steps", self.world_steps),
        ])?;
        contents.check_squares()?;
        dqn.load(|name, shape| contents.tensor(name, shape), self.n_updates)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberwatch_acting::beliefs::KNOWN;
    use emberwatch_acting::config::AgentConfig;

    #[test]
    fn errors_name_what_is_wrong_with_a_checkpoint() {
        let config = AgentConfig::default();
        let dqn = Dqn::new(config.decisions.settings(), SHAPE, 3);
        let state = SavedDecisions {
            options: OPTIONS.map(|option| option.name.into()).into(),
            estimator: KNOWN.name.into(),
            belief: None,
            n_updates: 3,
            world_steps: 7,
        };
        let mut contents = Contents::new(dqn.named_tensors(), &state);
        let read = |contents: &Contents| read(contents, &Device::Cpu, &mut Learned::default());
        let error = read(&contents).expect_err("no settings").to_string();
        assert!(error.starts_with("settings: expected"), "{error}");
        contents.settings = toml::to_string(&config).expect("TOML");
        assert!(!read(&contents).expect("whole"));
        let refused = |change: fn(&mut SavedDecisions), words: &str| {
            let (mut other, mut saved) = (contents.clone(), state.clone());
            change(&mut saved);
            other.set_state(&saved);
            let error = read(&other).expect_err(words).to_string();
            assert!(error.starts_with(words), "{error}");
        };
        let words = "options: expected exploit exploit_entropy";
        refused(|saved| saved.options.truncate(1), words);
        let words = "n_updates: expected at most";
        refused(|saved| saved.n_updates = u64::MAX, words);
    }
}
