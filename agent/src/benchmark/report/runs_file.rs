//! CSV files of runs. A file is written completely or not at all.

use crate::benchmark::report::policy_run::PolicyRun;
use anyhow::{Context, Result, ensure};
use emberwatch_learning::file::{check_replaceable, replace_file};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Checks that a file can be written, before the work for it begins.
pub fn check_runs_file(path: &Path) -> Result<()> {
    ensure!(
        !path.exists() || path.is_file(),
        "write {}: expected a regular file, got a folder or device",
        path.display()
    );
    check_replaceable(path)
}

/// Writes runs, ordered by policy, then seed. Numbers have the shortest text that parses to the same `f64`.
pub fn write_runs(path: &Path, runs: &[PolicyRun]) -> Result<()> {
    let mut sorted: Vec<&PolicyRun> = runs.iter().collect();
    sorted.sort_by_key(|run| {
        let crew = (run.robots, &run.team);
        (&run.policy, run.world_seed, &run.estimator, crew)
    });
    let mut writer = csv::Writer::from_writer(Vec::new());
    sorted.iter().try_for_each(|run| writer.serialize(run))?;
    replace_file(path, &writer.into_inner()?)
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

/// Reads the runs of files whose folders have the names of the runs' tasks. Skips files that do not exist.
pub fn read_tasks(files: impl IntoIterator<Item = PathBuf>) -> Result<Vec<PolicyRun>> {
    let mut all = Vec::new();
    for file in files.into_iter().filter(|file| file.is_file()) {
        let folder = file.parent().and_then(Path::file_name).unwrap_or_default();
        let task = folder.display().to_string();
        let runs = read_runs(&file)?.into_iter();
        all.extend(runs.map(|run| PolicyRun {
            task: task.clone(),
            ..run
        }));
    }
    Ok(all)
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
