//! One CSV row per policy and world: the numbers behind the table, for other tools to read.

use crate::benchmark::report::file::{ReportError, replace_file};
use crate::benchmark::report::policy_run::PolicyRun;
use std::path::Path;

pub(super) const HEADER: [&str; 11] = [
    "policy",
    "estimator",
    "world_seed",
    "steps",
    "mean_reward",
    "mean_distinct_cells",
    "hit_rate",
    "mean_fire_cells",
    "mean_plan_millis",
    "brier",
    "moves",
];

/// Writes one row per run, ordered by policy, then seed; a missing Brier score is an empty field.
///
/// Numbers are the shortest that read back as the same `f64`.
///
/// # Errors
/// [`ReportError::Write`] names the file, which is then as it was before.
pub fn write_csv(path: &Path, runs: &[PolicyRun]) -> Result<(), ReportError> {
    let mut sorted: Vec<&PolicyRun> = runs.iter().collect();
    sorted.sort_by_key(|run| (&run.policy, run.world_seed, &run.estimator));
    replace_file(path, "csv", |temporary| write_rows(temporary, &sorted))
}

fn write_rows(path: &Path, runs: &[&PolicyRun]) -> Result<(), ::csv::Error> {
    let mut writer = ::csv::Writer::from_path(path)?;
    writer.write_record(HEADER)?;
    for run in runs {
        writer.write_record(record(run))?;
    }
    Ok(writer.flush()?)
}

fn record(run: &PolicyRun) -> [String; 11] {
    // `{:?}` is Rust's shortest round-trip form, with an exponent where `{}` would fill the line.
    let number = |value: f64| format!("{value:?}");
    [
        run.policy.clone(),
        run.estimator.clone(),
        run.world_seed.to_string(),
        run.steps.to_string(),
        number(run.mean_reward),
        number(run.mean_distinct_cells),
        number(run.hit_rate),
        number(run.mean_fire_cells),
        number(run.mean_plan_millis),
        run.brier.map(number).unwrap_or_default(),
        run.moves.to_string(),
    ]
}
