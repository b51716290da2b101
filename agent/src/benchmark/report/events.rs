//! Rewards over time for TensorBoard, with one run per policy.

use crate::benchmark::report::policy_run::{Group, PolicyRun, groups};
use crate::benchmark::report::statistics::Estimate;
use crate::training::tensorboard::{EventFile, Value};
use anyhow::Result;
use std::path::Path;

/// Writes each step's reward, as mean and standard error over worlds, into one folder per policy. Steps start at 1.
pub fn write_events(folder: &Path, runs: &[PolicyRun]) -> Result<()> {
    let groups = groups(runs);
    for group in &groups {
        let name = [vec![group.policy.to_owned()], group.marks(&groups)].concat();
        let is_safe = |it: char| it.is_ascii_alphanumeric() || it == '-';
        let name = name.join("-").replace(|it| !is_safe(it), "_");
        let mut file = EventFile::begin(&folder.join(name), 0)?;
        for (index, reward) in rewards(group).into_iter().enumerate() {
            let error = reward.standard_error;
            let error = error.map(|error| ("reward_standard_error", Value::Scalar(error)));
            let mean = ("reward", Value::Scalar(reward.mean));
            file.add(index as u64 + 1, [mean].into_iter().chain(error))?;
        }
        file.flush()?;
    }
    Ok(())
}

/// Estimates the reward of each step, over the worlds whose run has that step.
fn rewards(group: &Group<'_>) -> Vec<Estimate> {
    let rewards = group.runs.iter().map(|run| &run.rewards);
    let n_steps = rewards.clone().map(Vec::len).max().unwrap_or(0);
    let of_step = |step: usize| {
        let there = rewards.clone().filter_map(|rewards| rewards.get(step));
        let there: Vec<f64> = there.copied().map(f64::from).collect();
        Estimate::of(&there)
    };
    (0..n_steps).filter_map(of_step).collect()
}
