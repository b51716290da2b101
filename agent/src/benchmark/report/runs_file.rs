//! The CSV file of runs, which only one process at a time can replace.
//!
//! `emberwatch.benchmark` in Python locks and replaces the file in the same way, so that no writer loses another's
//! rows.

use crate::benchmark::report::policy_run::PolicyRun;
use anyhow::{Context, Result, bail, ensure};
use emberwatch_learning::file::{Readers, check_replaceable, replace_file};
use std::fs::{File, OpenOptions, TryLockError};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

const RETRY_INTERVAL: Duration = Duration::from_millis(20);

/// A CSV file of runs, locked until this value is dropped. If the file is new and gets no runs, it is removed again.
#[derive(Debug)]
pub struct RunsFile {
    path: PathBuf,
    file: File,
}

impl RunsFile {
    /// Creates the file if it is missing, and locks it. If another process has it locked, waits at most `patience`.
    ///
    /// # Errors
    /// If the file cannot be replaced, or if another process still holds the lock after `patience`.
    pub fn lock(path: &Path, patience: Duration) -> Result<Self> {
        let locked = || {
            ensure!(
                !path.exists() || path.is_file(),
                "expected a regular file, got a folder or device"
            );
            let file = lock(path, Instant::now() + patience)?;
            // The file behind a symbolic link is replaced, not the link.
            let path = path.canonicalize()?;
            anyhow::Ok(Self { path, file })
        };
        let locked = locked().with_context(|| format!("write {}", path.display()))?;
        check_replaceable(&locked.path)?;
        Ok(locked)
    }

    /// Reads the file's runs. A new file contains no runs.
    pub fn read(&self) -> Result<Vec<PolicyRun>> {
        read_runs(&self.path)
    }

    /// Replaces the file with one row per run, ordered by policy, then seed. A missing value is an empty field.
    ///
    /// Numbers have the shortest text that parses to the same `f64`.
    pub fn replace(self, runs: &[PolicyRun]) -> Result<()> {
        let mut sorted: Vec<&PolicyRun> = runs.iter().collect();
        sorted.sort_by_key(|run| {
            let crew = (run.robots, &run.team);
            (&run.policy, run.world_seed, &run.estimator, crew)
        });
        let mut writer = csv::Writer::from_writer(Vec::new());
        sorted.iter().try_for_each(|run| writer.serialize(run))?;
        replace_file(&self.path, &writer.into_inner()?, Readers::Any)
    }
}

impl Drop for RunsFile {
    fn drop(&mut self) {
        let is_empty = self.file.metadata().is_ok_and(|found| found.len() == 0);
        if is_empty && is_at(&self.path, &self.file) {
            // If removal fails, the empty file does no harm.
            let _ = std::fs::remove_file(&self.path);
        }
    }
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

fn lock(path: &Path, deadline: Instant) -> Result<File> {
    let mut options = OpenOptions::new();
    options.read(true).write(true).create(true).truncate(false);
    loop {
        let file = options.open(path)?;
        match file.try_lock() {
            Ok(()) if is_at(path, &file) => return Ok(file),
            // Another process has replaced or removed the file since it was opened.
            Ok(()) => continue,
            Err(TryLockError::Error(error)) => bail!(error),
            Err(TryLockError::WouldBlock) => ensure!(
                Instant::now() < deadline,
                "another process is writing it: wait until it has finished, or choose another file"
            ),
        }
        std::thread::sleep(RETRY_INTERVAL);
    }
}

/// Returns whether a path still names this open file.
fn is_at(path: &Path, file: &File) -> bool {
    let both = path.metadata().and_then(|at| Ok((at, file.metadata()?)));
    both.is_ok_and(|(at, file)| (at.dev(), at.ino()) == (file.dev(), file.ino()))
}
