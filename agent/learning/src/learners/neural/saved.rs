//! Checkpoints of neural beliefs: the model for policies, and the state from which learning resumes.

use super::behaviour::Behaviour;
use super::replay::LessonReplay;
use crate::beliefs::learned::{LearnedModel, SavedModel};
use crate::beliefs::neural::{NeuralModel, new_network, read_corrected};
use crate::checkpoint::{Contents, check, check_counts, check_earned};
use crate::learners::resume_point::ResumePoint;
use crate::reward::RewardEstimate;
use anyhow::Result;
use emberwatch_model::Shape;
use emberwatch_network::{Device, NeuralBelief};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::collections::BTreeMap;

/// A checkpoint of a neural belief, without its tensors.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct SavedNeural<'a> {
    pub shape: Shape,
    /// Number of observation values.
    pub n_observations: usize,
    pub n_updates: u64,
    /// Number of world steps, for all worlds together.
    pub world_steps: u64,
    pub(super) earned: f64,
    pub(super) filter: Option<SavedModel>,
    pub(super) reward: Cow<'a, RewardEstimate>,
    pub(super) replay: Cow<'a, LessonReplay>,
    pub(super) worlds: BTreeMap<u32, SavedRun>,
}

/// The saved state of a robot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct SavedRun {
    pub(super) resume_point: ResumePoint,
    pub(super) behaviour: Option<Behaviour>,
}

/// Loads the model that policies use. The network computes on `device`.
pub(super) fn read(contents: &Contents, device: &Device) -> Result<NeuralModel> {
    let saved: SavedNeural = contents.state()?;
    let mut network = new_network(saved.n_observations, device)?;
    saved.load_into(&mut network, contents)?;
    let target = saved.reward.target().unwrap_or(saved.n_observations - 1);
    Ok(NeuralModel {
        network,
        filter: saved.filter(contents)?,
        target,
    })
}

impl SavedNeural<'_> {
    /// Loads the filter whose prediction the network corrects, if any.
    pub(super) fn filter(&self, contents: &Contents) -> Result<Option<Box<LearnedModel>>> {
        let filter = self.filter.as_ref();
        let filter = filter.map(|it| read_corrected(it, self.n_observations, &contents.part("")));
        Ok(filter.transpose()?.map(Box::new))
    }

    /// Loads the network, and checks the counts and the reward estimate.
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

    /// Checks that the saved runs and frames fit the grid and the observations.
    pub(super) fn check_worlds(&self) -> Result<()> {
        check_earned(self.earned)?;
        let (shape, n) = (self.shape, self.n_observations);
        let robots = self.worlds.keys().copied();
        self.replay.check(shape, n, self.filter.is_some(), robots)?;
        self.worlds.values().try_for_each(|run| {
            run.resume_point.check(n, shape)?;
            let fits = run.behaviour.is_none_or(|behaviour| behaviour.is_of(shape));
            check(
                fits,
                "worlds.behaviour",
                format!("a goal on a {shape} grid"),
                "another",
            )
        })
    }
}
