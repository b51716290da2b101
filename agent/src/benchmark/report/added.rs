//! Runs that others measured, from CSV files: they stand beside a comparison's own if their worlds are
//! the same.

use crate::benchmark::report::policy_run::{PolicyRun, groups};
use anyhow::{Context, Result, ensure};
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

/// The runs of a CSV file that `compare --csv` or `emberwatch.benchmark` wrote.
pub fn read_csv(path: &Path) -> Result<Vec<PolicyRun>> {
    let mut reader = csv::Reader::from_path(path)?;
    let mut runs = reader
        .deserialize()
        .collect::<Result<Vec<PolicyRun>, _>>()?;
    ensure!(!runs.is_empty(), "expected rows, got none");
    for run in &mut runs {
        run.is_added = true;
        let numbers = [run.mean_reward, run.hit_rate, run.mean_fire_cells];
        ensure!(
            numbers.iter().all(|number| number.is_finite()),
            "policy {:?}: expected finite numbers, got {numbers:?}",
            run.policy
        );
    }
    Ok(runs)
}

/// Refuses runs of other worlds, steps or paths than a comparison's, before it runs.
pub fn check_settings(
    added: &[PolicyRun],
    policies: &[&str],
    seeds: &Range<u64>,
    (steps, recent_steps): (u64, u32),
    moves: usize,
) -> Result<()> {
    for group in groups(added) {
        let policy = group.policy;
        ensure!(
            !policies.contains(&policy),
            "policy {policy:?}: expected a name that no policy compared has"
        );
        let mut found: Vec<u64> = group.runs.iter().map(|run| run.world_seed).collect();
        found.sort_unstable();
        let wanted: Vec<u64> = seeds.clone().collect();
        same(
            policy,
            "worlds",
            format!("{wanted:?}"),
            format!("{found:?}"),
        )?;
        for run in &group.runs {
            same(policy, "steps", steps, run.steps)?;
            same(policy, "moves of a path", moves, run.moves)?;
            if let Some(got) = run.recent_steps {
                same(policy, "--recent-steps", recent_steps, got)?;
            }
        }
    }
    Ok(())
}

/// Refuses runs of worlds that burnt otherwise: a world's fire depends on its seed, model, grid and
/// burn-in, and on no policy.
pub fn check_worlds(added: &[PolicyRun], runs: &[PolicyRun]) -> Result<()> {
    let fire = runs.iter().map(|run| (run.world_seed, run.mean_fire_cells));
    let fire: BTreeMap<u64, f64> = fire.collect();
    for run in added {
        let expected = fire.get(&run.world_seed).copied().unwrap_or_default();
        let seed = run.world_seed;
        let what = format!("burning cells of world {seed} (model, grid, burn-in)");
        same(&run.policy, &what, expected, run.mean_fire_cells).context("--add")?;
    }
    Ok(())
}

fn same<T: PartialEq + std::fmt::Display>(
    policy: &str,
    what: &str,
    expected: T,
    got: T,
) -> Result<()> {
    ensure!(
        expected == got,
        "policy {policy:?}: expected {what} {expected}, as those compared have, got {got}"
    );
    Ok(())
}
