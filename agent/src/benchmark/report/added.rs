//! Runs that others measured, from CSV files: they stand beside a comparison's own if their worlds are
//! the same.

use crate::benchmark::report::csv::HEADER;
use crate::benchmark::report::policy_run::{PolicyRun, groups};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};
use thiserror::Error;

/// Why runs cannot stand beside others.
#[derive(Debug, Error)]
pub enum AddedError {
    /// A file that is not what `compare --csv` and `emberwatch.benchmark` write.
    #[error("--add: {}: {source}", path.display())]
    File { path: PathBuf, source: ::csv::Error },
    #[error("--add: {}: expected the columns {}", .0.display(), HEADER.join(","))]
    Header(PathBuf),
    #[error("--add: policy {0:?}: expected a name that no policy compared has")]
    Taken(String),
    #[error(
        "--add: policy {policy:?}: expected {what} {expected}, as those compared have, got {got}"
    )]
    Other {
        policy: String,
        what: String,
        expected: String,
        got: String,
    },
}

/// A row as it stands in a file.
#[derive(Deserialize)]
struct Row {
    policy: String,
    estimator: String,
    world_seed: u64,
    steps: u64,
    mean_reward: f64,
    mean_distinct_cells: f64,
    hit_rate: f64,
    mean_fire_cells: f64,
    mean_plan_millis: f64,
    brier: Option<f64>,
    moves: usize,
}

/// The runs of a CSV file.
pub fn read_csv(path: &Path) -> Result<Vec<PolicyRun>, AddedError> {
    let file = |source| AddedError::File {
        path: path.into(),
        source,
    };
    let mut reader = ::csv::Reader::from_path(path).map_err(file)?;
    if reader.headers().map_err(file)? != HEADER.as_slice() {
        return Err(AddedError::Header(path.into()));
    }
    let rows = reader.deserialize().map(|row| row.map(Row::into_run));
    rows.collect::<Result<_, _>>().map_err(file)
}

/// Refuses runs of other worlds, steps or paths than a comparison's, before it runs.
pub fn check_settings(
    added: &[PolicyRun],
    policies: &[&str],
    seeds: &Range<u64>,
    steps: u64,
    moves: usize,
) -> Result<(), AddedError> {
    for group in groups(added) {
        if policies.contains(&group.policy) {
            return Err(AddedError::Taken(group.policy.into()));
        }
        let check =
            |what: &str, expected: String, got: String| same(group.policy, what, &expected, &got);
        let mut found: Vec<u64> = group.runs.iter().map(|run| run.world_seed).collect();
        found.sort_unstable();
        let wanted: Vec<u64> = seeds.clone().collect();
        check("worlds", format!("{wanted:?}"), format!("{found:?}"))?;
        for run in &group.runs {
            check("steps", steps.to_string(), run.steps.to_string())?;
            check("moves of a path", moves.to_string(), run.moves.to_string())?;
        }
    }
    Ok(())
}

/// Refuses runs of worlds that burnt otherwise: a world's fire depends on its seed, model, grid and
/// burn-in, and on no policy.
pub fn check_worlds(added: &[PolicyRun], runs: &[PolicyRun]) -> Result<(), AddedError> {
    let fire: BTreeMap<u64, f64> = runs
        .iter()
        .map(|run| (run.world_seed, run.mean_fire_cells))
        .collect();
    for run in added {
        let expected = fire.get(&run.world_seed).copied().unwrap_or_default();
        let what = format!("burning cells of world {}", run.world_seed);
        let (expected, got) = (expected.to_string(), run.mean_fire_cells.to_string());
        same(
            &run.policy,
            &format!("{what} (model, grid, burn-in)"),
            &expected,
            &got,
        )?;
    }
    Ok(())
}

fn same(policy: &str, what: &str, expected: &str, got: &str) -> Result<(), AddedError> {
    if expected == got {
        return Ok(());
    }
    Err(AddedError::Other {
        policy: policy.into(),
        what: what.into(),
        expected: expected.into(),
        got: got.into(),
    })
}

impl Row {
    fn into_run(self) -> PolicyRun {
        PolicyRun {
            policy: self.policy,
            estimator: self.estimator,
            world_seed: self.world_seed,
            steps: self.steps,
            mean_reward: self.mean_reward,
            mean_distinct_cells: self.mean_distinct_cells,
            hit_rate: self.hit_rate,
            mean_fire_cells: self.mean_fire_cells,
            mean_plan_millis: self.mean_plan_millis,
            brier: self.brier,
            moves: self.moves,
            is_added: true,
            rewards: Vec::new(),
        }
    }
}
