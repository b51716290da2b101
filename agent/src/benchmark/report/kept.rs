//! Results of a task that a folder keeps: a CSV file, and beside it the fingerprint of each policy's runs.

use crate::benchmark::report::added::read_csv;
use crate::benchmark::report::policy_run::{PolicyRun, write_csv};
use crate::file::{Readers, replace_file};
use anyhow::{Context, Result};
use emberwatch_protocol::program::read_text;
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// The results of one task.
#[derive(Debug)]
pub struct Kept {
    path: PathBuf,
    pub runs: Vec<PolicyRun>,
    /// Of each policy what its runs depend on, shortened. Rows from Python have none.
    marks: BTreeMap<String, String>,
}

impl Kept {
    /// What a folder has of a task, if anything.
    pub fn read(folder: &Path, task: &str) -> Result<Self> {
        let path = folder.join(format!("{task}.csv"));
        let runs = if path.exists() {
            read_csv(&path).with_context(|| path.display().to_string())?
        } else {
            Vec::new()
        };
        let beside = marks_beside(&path);
        let marks = if beside.exists() {
            let text = read_text(&beside).with_context(|| beside.display().to_string())?;
            toml::from_str(&text).with_context(|| beside.display().to_string())?
        } else {
            BTreeMap::new()
        };
        Ok(Self { path, runs, marks })
    }

    /// Whether a policy was run on all these worlds, for so many steps, with the same fingerprint.
    pub fn has(&self, policy: &str, mark: &str, seeds: &Range<u64>, steps: u64) -> bool {
        let has = |seed| {
            let mut runs = self.runs.iter();
            runs.any(|run| (&*run.policy, run.world_seed, run.steps) == (policy, seed, steps))
        };
        self.has_mark(policy, mark) && seeds.clone().all(has)
    }

    /// Whether a policy was run with the same fingerprint.
    pub fn has_mark(&self, policy: &str, mark: &str) -> bool {
        self.marks.get(policy).is_some_and(|it| it == mark)
    }

    /// The policies that have a fingerprint.
    pub fn marked(&self) -> impl Iterator<Item = &str> {
        self.marks.keys().map(|name| &**name)
    }

    /// Puts runs in the place of those that a policy has.
    pub fn replace(&mut self, policy: String, mark: String, runs: Vec<PolicyRun>) -> Result<()> {
        // Between the two files, should it end there, the policy has no fingerprint.
        self.marks.remove(&policy);
        self.write_marks()?;
        self.runs.retain(|run| run.policy != policy);
        self.runs.extend(runs);
        write_csv(&self.path, &self.runs)?;
        self.marks.insert(policy, mark);
        self.write_marks()
    }

    fn write_marks(&self) -> Result<()> {
        let text = toml::to_string(&self.marks)?;
        replace_file(&marks_beside(&self.path), text.as_bytes(), Readers::Any)
    }
}

fn marks_beside(path: &Path) -> PathBuf {
    path.with_extension("fingerprints.toml")
}
