//! What a comparison measured, and its groups.

use crate::file::{Readers, replace_file};
use anyhow::Result;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::Path;

/// One policy on one world: what `emberwatch-agent compare` measured, and a row of its CSV.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PolicyRun {
    /// Name of the policy, such as `beam`.
    pub policy: String,
    /// Where the belief came from: `none`, `known_model`, `truth`, `next_truth` or a learned one.
    pub estimator: String,
    pub world_seed: u64,
    pub steps: u64,
    pub mean_reward: f64,
    /// Mean number of distinct cells visited in a step.
    pub mean_distinct_cells: f64,
    /// Distinct visited cells on target, as a fraction of the distinct visited cells, in `0..=1`.
    pub hit_rate: f64,
    /// Mean number of burning cells of the world.
    pub mean_fire_cells: f64,
    /// Mean time of one plan in milliseconds.
    pub mean_plan_millis: f64,
    /// Mean Brier score of the belief, where there is a belief.
    pub brier: Option<f64>,
    /// Reward of each step, in order.
    #[serde(skip)]
    pub rewards: Vec<f32>,
}

/// Writes one row per run, ordered by policy, then seed; a missing Brier score is an empty field.
///
/// Numbers are the shortest that read back as the same `f64`.
pub fn write_csv(path: &Path, runs: &[PolicyRun]) -> Result<()> {
    let mut sorted: Vec<&PolicyRun> = runs.iter().collect();
    sorted.sort_by_key(|run| (&run.policy, run.world_seed, &run.estimator));
    let mut writer = csv::Writer::from_writer(Vec::new());
    sorted.iter().try_for_each(|run| writer.serialize(run))?;
    replace_file(path, &writer.into_inner()?, Readers::Any)
}

/// The runs of one policy with one estimator, in the order given.
pub(super) struct Group<'a> {
    pub(super) policy: &'a str,
    pub(super) estimator: &'a str,
    pub(super) runs: Vec<&'a PolicyRun>,
}

impl Group<'_> {
    pub(super) fn values(&self, value: impl Fn(&PolicyRun) -> f64) -> Vec<f64> {
        self.runs.iter().map(|run| value(run)).collect()
    }

    pub(super) fn by_seed(&self, value: impl Fn(&PolicyRun) -> f64) -> BTreeMap<u64, f64> {
        let pair = |run: &&PolicyRun| (run.world_seed, value(run));
        self.runs.iter().map(pair).collect()
    }
}

/// Groups runs by policy and estimator, ordered by first appearance.
pub(super) fn groups(runs: &[PolicyRun]) -> Vec<Group<'_>> {
    let mut groups: Vec<Group<'_>> = Vec::new();
    for run in runs {
        let (policy, estimator) = (run.policy.as_str(), run.estimator.as_str());
        let same = |group: &&mut Group<'_>| (group.policy, group.estimator) == (policy, estimator);
        match groups.iter_mut().find(same) {
            Some(group) => group.runs.push(run),
            None => groups.push(Group {
                policy,
                estimator,
                runs: vec![run],
            }),
        }
    }
    groups
}
