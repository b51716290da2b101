//! Checks that runs can be compared: that they were measured on the same worlds, over the same steps.

use crate::benchmark::report::policy_run::{PolicyRun, groups};
use anyhow::{Result, ensure};
use std::fmt::Display;

/// The worlds that runs of a comparison, a task or the leaderboard must have in common.
#[derive(Debug, Clone)]
pub struct CommonWorlds {
    /// The server's `worlds_fingerprint`.
    pub fingerprint: String,
    /// World seeds, in ascending order.
    pub seeds: Vec<u64>,
    pub steps: u64,
    /// Steps for which a cell counts as seen after a visit; `None` skips this check.
    pub recent_steps: Option<u32>,
}

impl CommonWorlds {
    /// Checks that a policy has one run for each of these worlds.
    pub fn check(&self, policy: &str, runs: &[&PolicyRun]) -> Result<()> {
        for run in runs {
            let (expected, got) = (&self.fingerprint, &run.worlds_fingerprint);
            let what = "worlds_fingerprint (model, grid, sensor, moves, robots, start, burn-in)";
            ensure!(
                !got.is_empty(),
                "policy {policy:?}: {what}: expected {expected}, got none"
            );
            same(run, what, expected, got)?;
            same(run, "steps", self.steps, run.steps)?;
            if let (Some(expected), Some(got)) = (self.recent_steps, run.recent_steps) {
                same(run, "--recent-steps", expected, got)?;
            }
        }
        let mut found: Vec<u64> = runs.iter().map(|run| run.world_seed).collect();
        found.sort_unstable();
        ensure!(
            found == self.seeds,
            "policy {policy:?}: expected one row for each world, {}, got {}",
            counted(&self.seeds),
            counted(&found)
        );
        Ok(())
    }
}

/// Checks runs from other files before a comparison of `policies` starts.
pub fn check_added(added: &[PolicyRun], policies: &[&str], worlds: &CommonWorlds) -> Result<()> {
    for group in groups(added) {
        ensure!(
            !policies.contains(&group.policy),
            "policy {:?}: expected a name that no compared policy has",
            group.policy
        );
        worlds.check(group.policy, &group.runs)?;
    }
    Ok(())
}

/// Describes worlds by their number and their first and last seed.
fn counted(seeds: &[u64]) -> String {
    match seeds {
        [] => "none".into(),
        [first, .., last] => format!("{} from seed {first} to {last}", seeds.len()),
        [only] => format!("1 of seed {only}"),
    }
}

fn same<T: PartialEq + Display>(run: &PolicyRun, what: &str, expected: T, got: T) -> Result<()> {
    ensure!(
        expected == got,
        "policy {:?} on world {}: {what}: expected {expected}, got {got}: run it on the same worlds",
        run.policy,
        run.world_seed
    );
    Ok(())
}
