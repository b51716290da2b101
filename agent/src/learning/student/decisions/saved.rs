//! Decisions in a checkpoint: the DQN, what the belief's filter learned, and where the robots are.

use super::run::{Base, Held, Run, SHAPE};
use crate::estimation::Correlations;
use crate::estimation::belief::Belief;
use crate::estimation::parameters::{Dimensions, Parameters};
use crate::learning::checkpoint::{
    Contents, check, check_belief, check_counts, check_numbers, wrong,
};
use crate::learning::learner::LearnedModel;
use crate::learning::student::base::{Place, place};
use crate::planning::options::N_FEATURES;
use crate::planning::policy::EstimatorKind;
use crate::planning::{BasisKind, Memory, OPTIONS};
use crate::rollout::Robot;
use ::network::{Dqn, NamedTensor, SavedDqn, Track};
use anyhow::Result;
use protocol::Shape;
use protocol::client::Observation;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Arc;

/// More updates than a step of all worlds earns.
const MOST_EARNED: f64 = 2e6;

/// Before the names of the filter's tensors.
const FILTER: &str = "filter.";

/// What policies act on.
#[derive(Debug, Clone)]
pub struct LearnedDecisions {
    pub scorer: Arc<Dqn>,
    /// What keeps the belief.
    pub estimator: EstimatorKind,
    /// What paths are planned on.
    pub basis: BasisKind,
}

/// All of a checkpoint of decisions but the tensors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SavedDecisions {
    pub options: Vec<String>,
    pub estimator: EstimatorKind,
    model: Option<SavedModel>,
    pub world_steps: u64,
    pub(super) earned: f64,
    pub dqn: SavedDqn,
    pub(super) worlds: BTreeMap<u32, SavedRun>,
}

/// What a filter learned, without its tensors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct SavedModel {
    dimensions: Dimensions,
    target: usize,
    correlations: Correlations,
}

/// Where a world was left.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct SavedRun {
    place: Place,
    frame: Vec<u8>,
    /// All that the estimator remembers.
    belief: Vec<u8>,
    estimate: Option<Belief>,
    memory: Memory,
    last: Option<(Vec<f32>, f32)>,
    track: Track,
    held: Held,
}

impl LearnedDecisions {
    /// From a checkpoint, with what the belief's filter learned, if it did.
    pub fn read(contents: &Contents) -> Result<(Self, Option<LearnedModel>)> {
        let config = contents.settings()?;
        let saved: SavedDecisions = contents.state()?;
        let mut dqn = Dqn::new(config.decisions.settings(), SHAPE, config.seed);
        saved.load_into(&mut dqn, contents)?;
        let decisions = Self {
            scorer: Arc::new(dqn),
            estimator: saved.estimator,
            basis: config.objective.belief,
        };
        Ok((decisions, saved.model(contents)?))
    }
}

impl SavedDecisions {
    /// As a checkpoint, without the settings.
    pub(super) fn contents(
        base: &Base,
        dqn: &Dqn,
        (world_steps, earned): (u64, f64),
        runs: impl Iterator<Item = (u32, SavedRun)>,
    ) -> Contents {
        let model = base.model.as_ref();
        let state = Self {
            options: OPTIONS.map(|option| option.name.into()).into(),
            estimator: base.kind,
            model: model.map(|model| SavedModel {
                dimensions: model.tables.dimensions,
                target: model.target,
                correlations: model.correlations.clone(),
            }),
            world_steps,
            earned,
            dqn: dqn.saved(),
            worlds: runs.collect(),
        };
        let of_filter = model.into_iter().flat_map(filter_tensors);
        Contents::new(dqn.named_tensors().into_iter().chain(of_filter), &state)
    }

    /// What the belief's filter learned, if it did.
    pub fn model(&self, contents: &Contents) -> Result<Option<LearnedModel>> {
        let Some(saved) = &self.model else {
            return Ok(None);
        };
        let dimensions = Dimensions {
            sees_own_state: self.estimator.sees_own_state(),
            ..saved.dimensions
        };
        let dimensions = dimensions.check();
        let dimensions =
            dimensions.map_err(|error| wrong("dimensions", "those of a filter", error))?;
        let (n_states, target) = (dimensions.n_states, saved.target);
        check(
            target < n_states,
            "target",
            format!("less than {n_states}"),
            target,
        )?;
        let mut parameters = Parameters::zeros(dimensions);
        for (at, shape) in dimensions.shapes().iter().enumerate() {
            let name = format!("{FILTER}{}", Parameters::NAMES[at]);
            parameters.tensors[at] = contents.tensor(&name, shape)?;
        }
        let correlations = saved.correlations.clone();
        Ok(Some(LearnedModel::new(parameters, target, correlations)))
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

impl Base {
    /// What a checkpoint's decisions are on, if that was learned.
    pub fn saved(contents: &Contents, shape: Shape) -> Result<Option<Self>> {
        let saved: SavedDecisions = contents.state()?;
        let model = saved.model(contents)?;
        Ok(model.map(|model| Self::learned(saved.estimator, model, shape)))
    }
}

impl SavedRun {
    pub(super) fn of(run: &Run) -> Self {
        let (agent, observation) = (&run.robot.agent, run.robot.observation());
        Self {
            place: place(observation),
            frame: observation.frame.as_bytes().to_vec(),
            belief: agent.estimator().memory(),
            estimate: agent.estimate().cloned(),
            memory: agent.memory.clone(),
            last: run.last.clone(),
            track: run.track.clone(),
            held: run.held,
        }
    }

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
        let (most, got) = (OPTIONS.len(), self.held.option);
        check(got < most, "worlds.held", format!("less than {most}"), got)
    }

    /// Goes on with a robot that has not yet taken in what its world shows.
    pub(super) fn restore(self, mut robot: Robot, dqn: &Dqn) -> Result<Run> {
        let agent = &mut robot.agent;
        let is_taken = agent.estimator_mut().remember(&self.belief);
        check(
            is_taken,
            "worlds.belief",
            "that of its estimator",
            "another",
        )?;
        agent.remember_estimate(self.estimate.as_ref());
        agent.memory = self.memory;
        Ok(Run {
            robot,
            last: self.last,
            track: dqn.resume_track(self.track)?,
            held: self.held,
            next: None,
        })
    }
}

fn filter_tensors(model: &LearnedModel) -> impl Iterator<Item = NamedTensor> {
    let parameters = &model.parameters;
    let shapes = parameters.dimensions.shapes().into_iter();
    let named = Parameters::NAMES
        .iter()
        .zip(shapes)
        .zip(&parameters.tensors);
    let named =
        named.map(|((name, shape), numbers)| (format!("{FILTER}{name}"), shape, numbers.clone()));
    named.collect::<Vec<_>>().into_iter()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::AgentConfig;

    #[test]
    fn what_is_wrong_with_a_checkpoint_is_named() {
        let config = AgentConfig::default();
        let dqn = Dqn::new(config.decisions.settings(), SHAPE, 3);
        let state = SavedDecisions {
            options: OPTIONS.map(|option| option.name.into()).into(),
            estimator: EstimatorKind::KnownModel,
            model: None,
            world_steps: 7,
            earned: 0.5,
            dqn: dqn.saved(),
            worlds: BTreeMap::new(),
        };
        let mut contents = Contents::new(dqn.named_tensors(), &state);
        let read = |contents: &Contents| LearnedDecisions::read(contents).map(drop);
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
}
