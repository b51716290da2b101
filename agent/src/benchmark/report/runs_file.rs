//! CSV files of runs. A file is written completely or not at all.

use crate::benchmark::report::policy_run::PolicyRun;
use anyhow::{Context, Result, ensure};
use emberwatch_learning::file::{Readers, check_replaceable, replace_file};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Checks that a file can be written, before the work for it begins.
pub fn check_runs_file(path: &Path) -> Result<()> {
    ensure!(
        !path.exists() || path.is_file(),
        "write {}: expected a regular file, got a folder or device",
        path.display()
    );
    check_replaceable(&target(path))
}

/// Writes one row per run, ordered by policy, then seed. A missing value is an empty field.
///
/// Numbers have the shortest text that parses to the same `f64`.
pub fn write_runs(path: &Path, runs: &[PolicyRun]) -> Result<()> {
    let mut sorted: Vec<&PolicyRun> = runs.iter().collect();
    sorted.sort_by_key(|run| {
        let crew = (run.robots, &run.team);
        (&run.policy, run.world_seed, &run.estimator, crew)
    });
    let mut writer = csv::Writer::from_writer(Vec::new());
    sorted.iter().try_for_each(|run| writer.serialize(run))?;
    replace_file(&target(path), &writer.into_inner()?, Readers::Any)
}

/// Reads the runs of a CSV file that `compare --csv`, `suite` or `emberwatch.benchmark` wrote.
pub fn read_runs(path: &Path) -> Result<Vec<PolicyRun>> {
    let read = || {
        let rows = csv::Reader::from_path(path)?.into_deserialize();
        let runs = rows.collect::<Result<Vec<PolicyRun>, _>>()?;
        for run in &runs {
            let numbers = [run.mean_reward, run.hit_rate, run.mean_fire_cells];
            ensure!(
                numbers.iter().all(|number| number.is_finite()),
                "policy {:?}: expected finite numbers, got {numbers:?}",
                run.policy
            );
        }
        Ok(runs)
    };
    let expected = "expected a CSV file of `compare --csv` or emberwatch.benchmark";
    read().with_context(|| format!("{}: {expected}", path.display()))
}

/// Reads the runs of all policies on a task, from the CSV files in its folder, which has the task's name.
pub fn read_task(folder: &Path) -> Result<Vec<PolicyRun>> {
    let files = csv_files(folder)?;
    let runs = files.iter().map(|file| read_task_file(file));
    Ok(runs.collect::<Result<Vec<_>>>()?.concat())
}

/// Reads a policy's runs on all tasks, which have a folder each.
pub fn read_policy(folder: &Path, policy: &str) -> Result<Vec<PolicyRun>> {
    let tasks = std::fs::read_dir(folder)?.map(|task| Ok(task?.path().join(file_of(policy))));
    let mut files = tasks.collect::<Result<BTreeSet<_>>>()?;
    files.retain(|file| file.is_file());
    let runs = files.iter().map(|file| read_task_file(file));
    let mut runs = runs.collect::<Result<Vec<_>>>()?.concat();
    runs.retain(|run| run.policy == policy);
    ensure!(!runs.is_empty(), "expected results of {policy:?}, got none");
    Ok(runs)
}

fn read_task_file(path: &Path) -> Result<Vec<PolicyRun>> {
    let mut runs = read_runs(path)?;
    let task = path.parent().and_then(Path::file_name).unwrap_or_default();
    for run in &mut runs {
        run.task = task.display().to_string();
    }
    Ok(runs)
}

/// Lists the CSV files of a folder, ordered by name.
pub fn csv_files(folder: &Path) -> Result<BTreeSet<PathBuf>> {
    let entries = std::fs::read_dir(folder)?.map(|entry| Ok(entry?.path()));
    let mut files = entries.collect::<Result<BTreeSet<_>>>()?;
    files.retain(|path| path.extension().is_some_and(|it| it == "csv"));
    Ok(files)
}

/// Returns the name of a policy's file. The `/` and `+` of BELIEF/PLANNER/GOAL become `_`.
pub fn file_of(policy: &str) -> String {
    format!("{}.csv", file_stem(policy))
}

/// Returns [`file_of`] without its ending.
pub fn file_stem(policy: &str) -> String {
    policy.replace(['/', '+'], "_")
}

/// Returns the file behind a symbolic link, which is replaced instead of the link.
fn target(path: &Path) -> PathBuf {
    path.canonicalize().unwrap_or_else(|_| path.to_owned())
}
