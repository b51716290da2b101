//! Decisions in a checkpoint: the DQN, the belief that they were learned on, and where the robots are.

use crate::belief::{LearnedBelief, SavedBelief};
use crate::checkpoint::{Contents, check, check_belief, check_counts, check_numbers};
use crate::learners::base::{Place, place};
use crate::policy::EstimatorKind;
use anyhow::Result;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::planning::options::N_FEATURES;
use emberwatch_belief::planning::{BasisKind, Memory, OPTIONS};
use emberwatch_messages::observation::Observation;
use emberwatch_model::Shape;
use emberwatch_network::{Device, Dqn, DqnShape, NamedTensor, SavedDqn, Track};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Arc;

/// What a decision is made on, and among.
pub const SHAPE: DqnShape = DqnShape::of_candidates(N_FEATURES, OPTIONS.len());

/// More updates than a step of all worlds earns.
const MOST_EARNED: f64 = 2e6;

/// Longest time for which an option is held, steps.
const LONGEST_HOLD: u64 = 1000;

/// Before the names of the belief's tensors.
const BELIEF: &str = "belief.";

/// A random option that is flown for some steps in a row.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Held {
    pub(super) option: usize,
    pub(super) n_steps: u64,
}

/// What policies act on.
#[derive(Debug, Clone)]
pub struct LearnedDecisions {
    pub scorer: Arc<Dqn>,
    /// What keeps the belief.
    pub estimator: EstimatorKind,
    /// What paths are planned on.
    pub basis: BasisKind,
    /// Width of the beam search that plans the options.
    pub beam_width: usize,
}

/// All of a checkpoint of decisions but the tensors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SavedDecisions {
    pub options: Vec<String>,
    pub estimator: EstimatorKind,
    pub(super) belief: Option<SavedBelief>,
    pub world_steps: u64,
    pub(super) earned: f64,
    pub dqn: SavedDqn,
    pub(super) worlds: BTreeMap<u32, SavedRun>,
}

/// Where a world was left.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct SavedRun {
    pub(super) place: Place,
    pub(super) frame: Vec<u8>,
    /// All that the estimator remembers.
    pub(super) belief: Vec<u8>,
    pub(super) estimate: Option<Belief>,
    pub(super) memory: Memory,
    pub(super) last: Option<(Vec<f32>, f32)>,
    pub(super) track: Track,
    pub(super) held: Held,
}

impl LearnedDecisions {
    /// From a checkpoint, with the belief that was learned for them, if it was; a network computes on `device`.
    pub fn read(contents: &Contents, device: &Device) -> Result<(Self, Option<LearnedBelief>)> {
        let config = contents.settings()?;
        let saved: SavedDecisions = contents.state()?;
        let mut dqn = Dqn::new(config.decisions.settings(), SHAPE, config.seed);
        saved.load_into(&mut dqn, contents)?;
        let decisions = Self {
            scorer: Arc::new(dqn),
            estimator: saved.estimator,
            basis: config.objective.belief,
            beam_width: config.decisions.beam_width,
        };
        Ok((decisions, saved.belief(contents, device)?))
    }
}

impl SavedDecisions {
    /// The belief that was learned, if it was; a network computes on `device`.
    pub fn belief(&self, contents: &Contents, device: &Device) -> Result<Option<LearnedBelief>> {
        let is_neural = matches!(self.belief, Some(SavedBelief::Neural { .. }));
        let fits = is_neural == (self.estimator == EstimatorKind::Neural);
        check(fits, "belief", self.estimator.label(), "another")?;
        let is_own = self.estimator.sees_own_state();
        let belief = self.belief.as_ref();
        belief
            .map(|it| it.read(is_own, &contents.part(BELIEF), device))
            .transpose()
    }

    pub(super) fn load_into(&self, dqn: &mut Dqn, contents: &Contents) -> Result<()> {
        let expected = OPTIONS.map(|option| option.name).join(" ");
        let got = self.options.join(" ");
        check(got == expected, "options", &expected, &got)?;
        check_counts(&[
            ("dqn.n_updates", self.dqn.n_updates),
            ("world_steps", self.world_steps),
        ])?;
        let fits = (0.0..MOST_EARNED).contains(&self.earned);
        check(fits, "earned", format!("0 to {MOST_EARNED}"), self.earned)?;
        contents.check_squares()?;
        dqn.load(|name, shape| contents.tensor(name, shape), &self.dqn)
    }
}

impl SavedRun {
    /// Whether a world shows what it showed then.
    pub(super) fn is_of(&self, observation: &Observation) -> bool {
        self.place == place(observation) && self.frame == observation.frame.as_bytes()
    }

    pub(super) fn check(&self, n_states: usize, shape: Shape) -> Result<()> {
        let mut estimates = self.estimate.iter();
        estimates
            .try_for_each(|estimate| check_belief("worlds.estimate", estimate, n_states, shape))?;
        let expected = format!("that of a {shape} grid");
        check(
            self.memory.is_of(shape),
            "worlds.memory",
            expected,
            "another",
        )?;
        if let Some((features, reward)) = &self.last {
            check_numbers("worlds.last", features, N_FEATURES)?;
            check_numbers("worlds.last", &[*reward], 1)?;
        }
        let Held { option, n_steps } = self.held;
        let expected = format!(
            "an option below {}, for at most {LONGEST_HOLD} steps",
            OPTIONS.len()
        );
        let fits = option < OPTIONS.len() && n_steps <= LONGEST_HOLD;
        check(
            fits,
            "worlds.held",
            expected,
            format!("{option} for {n_steps}"),
        )
    }
}

/// The tensors of a belief that was learned.
pub(super) fn belief_tensors(belief: &LearnedBelief) -> Result<Vec<NamedTensor>> {
    let named = |(name, shape, numbers)| (format!("{BELIEF}{name}"), shape, numbers);
    Ok(belief.tensors()?.into_iter().map(named).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::AgentConfig;
    use emberwatch_messages::message::{RobotResult, WorldResult};
    use emberwatch_model::Frame;

    #[test]
    fn what_is_wrong_with_a_checkpoint_is_named() {
        let config = AgentConfig::default();
        let dqn = Dqn::new(config.decisions.settings(), SHAPE, 3);
        let state = SavedDecisions {
            options: OPTIONS.map(|option| option.name.into()).into(),
            estimator: EstimatorKind::KNOWN,
            belief: None,
            world_steps: 7,
            earned: 0.5,
            dqn: dqn.saved(),
            worlds: BTreeMap::new(),
        };
        let mut contents = Contents::new(dqn.named_tensors(), &state);
        let read = |contents: &Contents| LearnedDecisions::read(contents, &Device::Cpu).map(drop);
        let error = read(&contents).expect_err("no settings").to_string();
        assert!(error.starts_with("settings: expected"), "{error}");
        contents.settings = toml::to_string(&config).expect("TOML");
        read(&contents).expect("whole");
        let refused = |change: fn(&mut SavedDecisions), words: &str| {
            let (mut other, mut saved) = (contents.clone(), state.clone());
            change(&mut saved);
            other.set_state(&saved);
            let error = read(&other).expect_err(words).to_string();
            assert!(error.starts_with(words), "{error}");
        };
        refused(
            |saved| saved.options.truncate(1),
            "options: expected exploit exploit_entropy",
        );
        refused(
            |saved| saved.dqn.n_updates = u64::MAX,
            "dqn.n_updates: expected at most",
        );
        refused(|saved| saved.earned = f64::NAN, "earned: expected 0 to");
    }

    #[test]
    fn an_option_is_held_for_a_time_that_settings_may_have() {
        let shape = Shape::new(2, 3).expect("test shape");
        let observation = Observation {
            world: WorldResult::default(),
            robot: RobotResult::default(),
            frame: Frame::empty(shape),
        };
        let dqn = Dqn::new(AgentConfig::default().decisions.settings(), SHAPE, 3);
        let held = |option, n_steps| {
            let run = SavedRun {
                place: place(&observation),
                frame: observation.frame.as_bytes().to_vec(),
                belief: Vec::new(),
                estimate: None,
                memory: Memory::new(shape),
                last: None,
                track: dqn.track(),
                held: Held { option, n_steps },
            };
            run.check(3, shape).is_ok()
        };
        assert!(held(OPTIONS.len() - 1, 1000));
        assert!(!held(OPTIONS.len(), 1) && !held(0, 1001));
    }
}
