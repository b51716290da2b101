//! `leaderboard`: adds an entry from the results of `suite`, and rebuilds the page of all entries.

use super::shared::write;
use crate::benchmark::report::leaderboard::{
    About, Entry, all_runs, check_entries, read_entries, render_page,
};
use crate::benchmark::report::leaderboard_chart::draw_leaderboard;
use crate::benchmark::report::runs_file::{file_of, read_tasks};
use anyhow::{Context, Result, ensure};
use clap::Args;
use emberwatch_learning::file::replace_file;
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
    #[command(flatten)]
    about: About,
}

impl LeaderboardCommand {
    pub fn run(&self) -> Result<()> {
        if let Some(folder) = &self.add {
            self.add(folder)?;
        }
        let entries = read_entries(&self.entries)?;
        check_entries(&entries)?;
        let table = render_page(&entries);
        let page = self.page.display();
        let text = std::fs::read_to_string(&self.page).with_context(|| page.to_string())?;
        let (kept, _) = text.split_once(MADE).with_context(|| {
            format!("{page}: expected a line {MADE} (the text below it is generated), got none")
        })?;
        let text = format!("{kept}{MADE}\n\n{table}");
        replace_file(&self.page, text.as_bytes())?;
        draw_leaderboard(&self.page.with_extension("svg"), &all_runs(&entries))?;
        write(&table)
    }

    fn add(&self, folder: &Path) -> Result<()> {
        let flag = || format!("--add {}", folder.display());
        let file = file_of(&self.about.policy);
        let tasks = std::fs::read_dir(folder).with_context(flag)?;
        let files = tasks.map(|task| Ok(task?.path().join(&file)));
        let mut entry = Entry {
            about: self.about.clone(),
            runs: read_tasks(files.collect::<Result<BTreeSet<_>>>()?)?,
        };
        let policy = &entry.about.policy;
        entry.runs.retain(|run| run.policy == *policy);
        ensure!(
            !entry.runs.is_empty(),
            "{}: expected results of {policy:?}, got none",
            flag()
        );
        entry.adopt_training_seconds();
        entry.check()?;
        let mut entries = read_entries(&self.entries)?;
        let policy = &entry.about.policy;
        entries.retain(|other| other.about.policy != *policy);
        let mut others = entries.iter();
        ensure!(
            others.all(|other| file_of(&other.about.policy) != file),
            "--policy {policy}: its file name is taken by another entry: choose another name"
        );
        entries.push(entry.clone());
        check_entries(&entries)?;
        entry.write(&self.entries.join(file))
    }
}
