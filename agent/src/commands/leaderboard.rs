//! `leaderboard`: adds an entry from the results of `suite`, and rebuilds the page of all entries.

use super::shared::write;
use crate::benchmark::report::leaderboard::{
    About, Entry, check_entries, file_stem, read_entries, render_page,
};
use crate::benchmark::report::leaderboard_chart::draw_leaderboard;
use crate::benchmark::report::runs_file::read_runs;
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
        let files =
            std::fs::read_dir(folder).with_context(|| format!("--add {}", folder.display()))?;
        let files = files
            .map(|file| Ok(file?.path()))
            .collect::<Result<BTreeSet<_>>>()?;
        let files = files
            .iter()
            .filter(|path| path.extension().is_some_and(|it| it == "csv"));
        let tasks = files
            .map(|path| task(path, &policy))
            .collect::<Result<Vec<_>>>()?;
        let tasks: Vec<TaskRuns> = tasks
            .into_iter()
            .filter(|task| !task.runs.is_empty())
            .collect();
        ensure!(
            !tasks.is_empty(),
            "--add {}: expected results of {:?}, got none",
            folder.display(),
            policy
        );
        let about = About {
            training_seconds: self.training_seconds(&tasks)?,
            policy,
            by: text(&self.by),
            code: text(&self.code),
            commit: text(&self.commit),
        };
        let path = self
            .entries
            .join(format!("{}.csv", file_stem(&about.policy)));
        let entry = Entry { about, tasks };
        entry.check()?;
        let mut entries = read_entries(&self.entries)?;
        entries.retain(|other| other.about.policy != entry.about.policy);
        let mut others = entries.iter().map(|other| &other.about.policy);
        let same = others.find(|other| file_stem(other) == file_stem(&entry.about.policy));
        ensure!(
            same.is_none(),
            "--policy {}: its file name is taken by the entry of {}: choose another name",
            entry.about.policy,
            same.unwrap_or(&entry.about.policy)
        );
        entries.push(entry.clone());
        check_entries(&entries)?;
        entry.write(&path)
    }

    /// Returns the value of `--training-seconds`. Without the flag, sums the training seconds recorded for each task.
    fn training_seconds(&self, tasks: &[TaskRuns]) -> Result<f64> {
        if let Some(seconds) = self.training_seconds {
            return Ok(seconds);
        }
        let seconds = tasks.iter().map(|task| {
            let seconds = task.runs[0].training_seconds;
            seconds.with_context(|| {
                format!(
                    "--training-seconds: expected a number, as the rows of task {} have none",
                    task.task
                )
            })
        });
        seconds.sum()
    }
}

/// Reads a policy's runs from a task's file.
fn task(path: &Path, policy: &str) -> Result<TaskRuns> {
    let name = path.file_stem().unwrap_or_default().display().to_string();
    let mut runs = read_runs(path)?;
    runs.retain(|run| run.policy == policy);
    Ok(TaskRuns { task: name, runs })
}
