//! Checks that runs can be compared: that they were measured on the same worlds, over the same steps.

use crate::benchmark::report::policy_run::{PolicyRun, groups};
use anyhow::{Context, Result, ensure};
use std::collections::BTreeMap;
use std::fmt::Display;

/// The worlds that runs of a comparison, a task or the leaderboard must have in common.
#[derive(Debug, Clone)]
pub struct CommonWorlds {
    /// The server's `worlds_fingerprint`. `None` skips this check.
    pub fingerprint: Option<String>,
    /// World seeds, in ascending order.
    pub seeds: Vec<u64>,
    pub steps: u64,
    /// Moves per path. For this and the next two fields, `None` skips the check.
    pub moves: Option<usize>,
    pub robots: Option<u32>,
    pub recent_steps: Option<u32>,
}

impl CommonWorlds {
    /// Checks that a policy has one run for each of these worlds, all with the same policy fingerprint.
    pub fn check(&self, policy: &str, runs: &[&PolicyRun]) -> Result<()> {
        for run in runs {
            same(run, "steps", self.steps, run.steps)?;
            let moves = self.moves.unwrap_or(run.moves);
            same(run, "moves", moves, run.moves)?;
            let robots = self.robots.unwrap_or(run.robots);
            same(run, "robots", robots, run.robots)?;
            if let (Some(expected), Some(got)) = (self.recent_steps, run.recent_steps) {
                same(run, "--recent-steps", expected, got)?;
            }
            if let Some(expected) = &self.fingerprint {
                let got = Some(&*run.worlds_fingerprint).filter(|got| !got.is_empty());
                let what = "worlds_fingerprint (model, grid, sensor, start, burn-in)";
                same(run, what, &**expected, got.unwrap_or("none"))?;
            }
            let of_first = &runs[0].policy_fingerprint;
            same(run, "policy_fingerprint", of_first, &run.policy_fingerprint)?;
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
        let policy = group.policy;
        ensure!(
            !policies.contains(&policy),
            "policy {policy:?}: expected a name that no compared policy has"
        );
        let is_old = group
            .runs
            .iter()
            .all(|run| run.worlds_fingerprint.is_empty());
        if is_old {
            tracing::warn!(
                "policy {policy:?} has no worlds_fingerprint: sensor and start of its worlds cannot be checked"
            );
        }
        let worlds = CommonWorlds {
            fingerprint: worlds.fingerprint.clone().filter(|_| !is_old),
            ..worlds.clone()
        };
        worlds.check(policy, &group.runs)?;
    }
    Ok(())
}

/// Checks that runs from other files had the same number of burning cells. A world's fire depends on its seed, model,
/// grid and burn-in, but not on the policy.
pub fn check_fire(added: &[PolicyRun], runs: &[PolicyRun]) -> Result<()> {
    let fire = runs.iter().map(|run| (run.world_seed, run.mean_fire_cells));
    let fire: BTreeMap<u64, f64> = fire.collect();
    for run in added {
        let expected = fire.get(&run.world_seed).copied().unwrap_or_default();
        let what = "burning cells (model, grid, burn-in)";
        same(run, what, expected, run.mean_fire_cells).context("--add")?;
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
