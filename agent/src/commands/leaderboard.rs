//! `leaderboard`: adds an entry from the results of `suite`, and rebuilds the page of all entries.

use super::shared::write;
use crate::benchmark::report::leaderboard::{
    About, Entry, check_entries, read_entries, render_page,
};
use crate::benchmark::report::leaderboard_chart::draw_leaderboard;
use crate::benchmark::report::runs_file::{file_of, read_runs};
use crate::benchmark::report::suite::TaskRuns;
use anyhow::{Context, Result, ensure};
use clap::Args;
use emberwatch_learning::file::{Readers, replace_file};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Mark in the page: the text above it is kept, the text below it is generated.
const MADE: &str = "<!-- made by `emberwatch-agent leaderboard` -->";

/// Add an entry to the leaderboard and rebuild its page and figure.
#[derive(Args)]
pub struct LeaderboardCommand {
    /// Folder of entries, one CSV file each
    #[arg(long, value_name = "FOLDER", default_value = "docs/leaderboard")]
    entries: PathBuf,
    /// Page to rebuild: the text below its mark is replaced; the figure is written next to it, as .svg
    #[arg(long, value_name = "FILE", default_value = "docs/leaderboard.md")]
    page: PathBuf,
    /// Add a policy from this folder of results, written by `suite --out` or `emberwatch.benchmark.suite` in Python
    #[arg(long, value_name = "FOLDER", requires_all = ["policy", "by", "code", "commit"])]
    add: Option<PathBuf>,
    /// Name of the policy to add
    #[arg(long, requires = "add")]
    policy: Option<String>,
    /// Author of the policy
    #[arg(long, requires = "add")]
    by: Option<String>,
    /// Where to find its code, such as an https:// address
    #[arg(long, requires = "add")]
    code: Option<String>,
    /// Commit of that code: 7 to 40 hexadecimal digits
    #[arg(long, requires = "add")]
    commit: Option<String>,
    /// Processor seconds of training, summed over all tasks [default: from the rows of `suite`]
    #[arg(long, value_name = "SECONDS", requires = "add")]
    training_seconds: Option<f64>,
}

impl LeaderboardCommand {
    /// Adds the entry of `--add`, if given, and rebuilds the page.
    pub fn run(&self) -> Result<()> {
        if let Some(folder) = &self.add {
            self.add(folder)?;
        }
        let entries = read_entries(&self.entries)?;
        check_entries(&entries)?;
        let table = render_page(&entries);
        let page =
            std::fs::read_to_string(&self.page).with_context(|| self.page.display().to_string())?;
        let (kept, _) = page.split_once(MADE).with_context(|| {
            format!(
                "{}: expected a line {MADE} (the text below it is generated), got none",
                self.page.display()
            )
        })?;
        let page = format!("{kept}{MADE}\n\n{table}");
        replace_file(&self.page, page.as_bytes(), Readers::Any)?;
        draw_leaderboard(&self.page.with_extension("svg"), &entries)?;
        write(&table)
    }

    fn add(&self, folder: &Path) -> Result<()> {
        let text = |flag: &Option<String>| flag.clone().unwrap_or_default();
        let policy = text(&self.policy);
        let tasks = tasks(folder, &policy)?;
        ensure!(
            !tasks.is_empty(),
            "--add {}: expected results of {policy:?}, got none",
            folder.display()
        );
        let recorded = tasks.iter().map(|task| task.runs[0].training_seconds).sum();
        let about = About {
            training_seconds: self.training_seconds.or(recorded).context(
                "--training-seconds: expected a number, as the rows of a task have none",
            )?,
            policy,
            by: text(&self.by),
            code: text(&self.code),
            commit: text(&self.commit),
        };
        let entry = Entry { about, tasks };
        entry.check()?;
        let mut entries = read_entries(&self.entries)?;
        entries.retain(|other| other.about.policy != entry.about.policy);
        let file = file_of(&entry.about.policy);
        for other in &entries {
            ensure!(
                file_of(&other.about.policy) != file,
                "--policy {}: its file name is taken by the entry of {}: choose another name",
                entry.about.policy,
                other.about.policy
            );
        }
        entries.push(entry.clone());
        check_entries(&entries)?;
        entry.write(&self.entries.join(file))
    }
}

/// Reads a policy's runs in the folder of each task.
fn tasks(folder: &Path, policy: &str) -> Result<Vec<TaskRuns>> {
    let folders =
        std::fs::read_dir(folder).with_context(|| format!("--add {}", folder.display()))?;
    let folders = folders.map(|entry| Ok(entry?.path()));
    let mut tasks = Vec::new();
    for folder in folders.collect::<Result<BTreeSet<_>>>()? {
        let path = folder.join(file_of(policy));
        if path.is_file() {
            let task = folder.file_name().unwrap_or_default().display().to_string();
            let mut runs = read_runs(&path)?;
            runs.retain(|run| run.policy == policy);
            tasks.push(TaskRuns { task, runs });
        }
    }
    tasks.retain(|task| !task.runs.is_empty());
    Ok(tasks)
}
