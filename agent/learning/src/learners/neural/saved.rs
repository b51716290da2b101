//! A neural belief in a checkpoint: what policies act on, and what learning goes on from.

use super::behaviour::Behaviour;
use super::replay::Replay;
use crate::checkpoint::{Contents, check, check_belief, check_counts};
use crate::estimation::NeuralEstimator;
use crate::learners::base::{Place, place};
use crate::learners::filter::fit::LearnedModel;
use crate::learners::filter::model::SavedModel;
use crate::reward::RewardEstimate;
use crate::rollout::Rollout;
use crate::rollout::agent::Agent;
use anyhow::Result;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_messages::observation::Observation;
use emberwatch_model::MAX_VALUES;
use emberwatch_model::Shape;
use emberwatch_network::{Device, NeuralBelief};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::collections::BTreeMap;

/// More updates than a step of all worlds earns.
const MOST_EARNED: f64 = 2e6;

/// What policies act on.
#[derive(Debug, Clone)]
pub struct NeuralModel {
    pub network: NeuralBelief,
    /// The filter that it corrects, if it does.
    pub filter: Option<Box<LearnedModel>>,
    /// The value that pays most.
    pub target: usize,
}

/// All of a checkpoint of a neural belief but the tensors.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct SavedNeural<'a> {
    pub shape: Shape,
    /// Number of values that an observed cell may show.
    pub n_observations: usize,
    pub n_updates: u64,
    /// World steps seen, of all worlds together.
    pub world_steps: u64,
    pub(super) earned: f64,
    pub(super) filter: Option<SavedModel>,
    pub(super) reward: Cow<'a, RewardEstimate>,
    pub(super) replay: Cow<'a, Replay>,
    pub(super) worlds: BTreeMap<u32, SavedRun>,
}

/// Where a robot was left.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct SavedRun {
    place: Place,
    frame: Vec<u8>,
    /// All that the estimator remembers.
    belief: Vec<u8>,
    estimate: Option<Belief>,
    pub(super) behaviour: Option<Behaviour>,
}

/// Alike where they believe alike.
impl PartialEq for NeuralModel {
    fn eq(&self, other: &Self) -> bool {
        let parameters = |model: &Self| model.network.parameters().ok();
        self.target == other.target
            && self.filter == other.filter
            && parameters(self) == parameters(other)
    }
}

impl NeuralModel {
    /// From a checkpoint; the network computes on `device`.
    pub fn read(contents: &Contents, device: &Device) -> Result<Self> {
        let saved: SavedNeural = contents.state()?;
        let mut network = new_network(saved.n_observations, device)?;
        saved.load_into(&mut network, contents)?;
        let target = saved.reward.target().unwrap_or(saved.n_observations - 1);
        Ok(Self {
            network,
            filter: saved.filter(contents)?,
            target,
        })
    }

    /// Before the first frame.
    pub fn estimator(&self, shape: Shape) -> Result<NeuralEstimator> {
        estimator(&self.network, self.filter.as_deref(), shape)
    }
}

/// Before the first frame; a filter that the network corrects reaches the neighbours of visited cells.
pub(super) fn estimator(
    network: &NeuralBelief,
    filter: Option<&LearnedModel>,
    shape: Shape,
) -> Result<NeuralEstimator> {
    let filter = filter.map(|it| it.estimator(true, shape)).transpose()?;
    Ok(NeuralEstimator::new(network, filter, shape)?)
}

/// A network whose parameters are still to be read; refuses numbers of observations that no world has.
pub fn new_network(n_observations: usize, device: &Device) -> Result<NeuralBelief> {
    let (fits, expected) = (1..=MAX_VALUES, format!("1 to {MAX_VALUES}"));
    let fits = fits.contains(&n_observations);
    check(fits, "n_observations", expected, n_observations)?;
    Ok(NeuralBelief::new(n_observations, 0, device)?)
}

impl SavedNeural<'_> {
    /// The filter that it corrects.
    pub(super) fn filter(&self, contents: &Contents) -> Result<Option<Box<LearnedModel>>> {
        let filter = self.filter.as_ref();
        let filter = filter.map(|it| it.read_corrected(self.n_observations, &contents.part("")));
        Ok(filter.transpose()?.map(Box::new))
    }

    /// Loads the network; refuses what does not fit.
    pub(super) fn load_into(&self, network: &mut NeuralBelief, contents: &Contents) -> Result<()> {
        check_counts(&[
            ("n_updates", self.n_updates),
            ("world_steps", self.world_steps),
        ])?;
        contents.check_squares()?;
        let find = |name: &str, shape: &[usize]| contents.tensor(name, shape);
        network.load(find, self.n_updates)?;
        self.reward.check(self.n_observations)
    }

    /// Refuses worlds and frames that do not fit.
    pub(super) fn check_worlds(&self) -> Result<()> {
        let fits = (0.0..MOST_EARNED).contains(&self.earned);
        check(fits, "earned", format!("0 to {MOST_EARNED}"), self.earned)?;
        let (shape, n) = (self.shape, self.n_observations);
        let robots = self.worlds.keys().copied();
        self.replay.check(shape, n, self.filter.is_some(), robots)?;
        self.worlds.values().try_for_each(|left| {
            let estimates = left.estimate.iter();
            let mut estimates = estimates.map(|it| check_belief("worlds.estimate", it, n, shape));
            estimates.try_for_each(|it| it)?;
            let fits = left
                .behaviour
                .is_none_or(|behaviour| behaviour.is_of(shape));
            check(
                fits,
                "worlds.behaviour",
                format!("a cell of {shape}"),
                "another",
            )
        })
    }
}

impl SavedRun {
    pub(super) fn of(rollout: &Rollout, behaviour: Option<Behaviour>) -> Self {
        let (agent, observation) = (&rollout.agent, rollout.observation());
        Self {
            place: place(observation),
            frame: observation.frame.as_bytes().to_vec(),
            belief: agent
                .estimator()
                .handover()
                .map(|it| it.to_bytes())
                .unwrap_or_default(),
            estimate: agent.estimate().cloned(),
            behaviour,
        }
    }

    /// Whether a world shows what it showed then.
    pub(super) fn is_of(&self, observation: &Observation) -> bool {
        self.place == place(observation) && self.frame == observation.frame.as_bytes()
    }

    /// Gives an agent what its estimator remembered, and the estimate if its paths are planned on that.
    pub(super) fn restore(&self, agent: &mut Agent) -> Result<()> {
        let estimator = agent.estimator_mut().handover_mut();
        let is_taken = estimator.is_some_and(|it| it.restore(&self.belief));
        check(
            is_taken,
            "worlds.belief",
            "that of its estimator",
            "another",
        )?;
        agent.remember_estimate(self.estimate.as_ref());
        Ok(())
    }
}
