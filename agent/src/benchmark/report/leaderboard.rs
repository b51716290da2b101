//! Entries of the leaderboard, one CSV file each, and the page of all entries.

use crate::benchmark::report::common_worlds::{check_worlds, worlds};
use crate::benchmark::report::number::{NOTHING, number};
use crate::benchmark::report::policy_run::PolicyRun;
use crate::benchmark::report::runs_file::{csv_files, file_stem};
use crate::benchmark::report::suite::{
    CEILING, FLOOR, PARTIAL, SCORE, by_score, render_suite, score_text, table, tasks,
};
use anyhow::{Context, Result, ensure};
use clap::Args;
use emberwatch_learning::file::replace_file;
use emberwatch_protocol::task::is_file_name;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

const NAME: &str = "1 to 64 letters, digits, '-', '_' and '.', for a policy also '/' and '+'";

const PLAIN: &str = "1 to 200 letters, digits, spaces and .,'-_&()@+/#?=%~, or an address that begins with https://";

/// One policy: its origin, and its runs in the worlds of each task.
#[derive(Debug, Clone)]
pub struct Entry {
    pub about: About,
    pub runs: Vec<PolicyRun>,
}

/// The origin of an entry's policy: flags, and the first columns of the entry's file.
#[derive(Debug, Clone, PartialEq, Args, Serialize, Deserialize)]
pub struct About {
    /// Name of the policy to add
    #[arg(long, requires = "add", default_value = "", hide_default_value = true)]
    pub policy: String,
    /// Author of the policy
    #[arg(long, requires = "add", default_value = "", hide_default_value = true)]
    pub by: String,
    /// Where to find its code, such as an https:// address
    #[arg(long, requires = "add", default_value = "", hide_default_value = true)]
    pub code: String,
    /// Commit of that code: 7 to 40 hexadecimal digits
    #[arg(long, requires = "add", default_value = "", hide_default_value = true)]
    pub commit: String,
    /// Processor seconds of training, summed over all tasks [default: from the rows of `suite`]
    #[arg(long, requires = "add", value_name = "SECONDS")]
    pub training_seconds: Option<f64>,
}

const COLUMNS: &str = "policy,by,code,commit,training_seconds,estimator,task,world_seed,steps,robots,team,mean_reward,\
                       brier,log_likelihood,worlds_fingerprint";

impl Entry {
    /// Reads a file written by [`Self::write`].
    pub fn read(path: &Path) -> Result<Self> {
        let mut rows = csv::Reader::from_path(path)?;
        let columns = rows.headers()?.clone();
        let (mut abouts, mut runs) = (Vec::new(), Vec::new());
        for row in rows.records() {
            let row = row?;
            abouts.push(row.deserialize::<About>(Some(&columns))?);
            runs.push(row.deserialize(Some(&columns))?);
        }
        let about = abouts.pop().context("expected rows, got none")?;
        ensure!(
            abouts.iter().all(|other| *other == about),
            "expected the same policy, by, code, commit and training_seconds in all rows, got different ones"
        );
        let entry = Self { about, runs };
        entry.check()?;
        Ok(entry)
    }

    /// Checks all texts and numbers, which come from flags or files, before they reach a page.
    pub fn check(&self) -> Result<()> {
        let about = &self.about;
        let mut texts = BTreeSet::from([
            ("policy", &*about.policy),
            ("by", &about.by),
            ("code", &about.code),
            ("commit", &about.commit),
        ]);
        for run in &self.runs {
            texts.extend([
                ("task", &*run.task),
                ("estimator", &run.estimator),
                ("team", &run.team),
            ]);
            let numbers = [Some(run.mean_reward), run.brier, run.log_likelihood];
            ensure!(
                numbers.iter().flatten().all(|number| number.is_finite()),
                "world {}: expected finite numbers, got {numbers:?}",
                run.world_seed
            );
        }
        for (what, text) in texts {
            let (is_right, expected) = match what {
                "policy" => (is_file_name(&file_stem(text)), NAME),
                "task" => (is_file_name(text), NAME),
                "commit" => (is_commit(text), "7 to 40 hexadecimal digits"),
                _ => (is_plain(text), PLAIN),
            };
            ensure!(is_right, "{what}: expected {expected}, got {text:?}");
        }
        let seconds = about
            .training_seconds
            .context("training_seconds: expected a number, got none in the flags and rows")?;
        ensure!(
            (0.0..1e12).contains(&seconds),
            "training_seconds: expected 0 or more, got {seconds}"
        );
        Ok(())
    }

    pub fn write(&self, path: &Path) -> Result<()> {
        let mut writer = csv::WriterBuilder::new()
            .has_headers(false)
            .from_writer(Vec::new());
        writer.write_record(COLUMNS.split(','))?;
        for run in &self.runs {
            let what = (&run.estimator, &run.task, run.world_seed, run.steps);
            let who = (run.robots, &run.team);
            let scores = (run.mean_reward, run.brier, run.log_likelihood);
            writer.serialize((&self.about, what, who, scores, &run.worlds_fingerprint))?;
        }
        replace_file(path, &writer.into_inner()?)
    }

    /// Sets the seconds of training from the rows of `suite`, unless they are known or a task's rows have none.
    pub fn adopt_training_seconds(&mut self) {
        let of_task = |task| self.on(task).next()?.training_seconds;
        let recorded = tasks(&self.runs).into_iter().map(of_task).sum();
        self.about.training_seconds = self.about.training_seconds.or(recorded);
    }

    fn on(&self, task: &str) -> impl Iterator<Item = &PolicyRun> {
        self.runs.iter().filter(move |run| run.task == task)
    }
}

/// Reads all entries of a folder, in the order of their file names.
pub fn read_entries(folder: &Path) -> Result<Vec<Entry>> {
    let files = csv_files(folder)
        .with_context(|| format!("expected a folder of entries at {}", folder.display()))?;
    let read =
        |path: &PathBuf| Entry::read(path).with_context(|| format!("entry {}", path.display()));
    files.iter().map(read).collect()
}

/// Checks that each entry has the same worlds as the random walk's entry, that the oracle has the same kind of team,
/// since both define the scale, and that no policy has two entries.
pub fn check_entries(entries: &[Entry]) -> Result<()> {
    let floor = entries.iter().find(|entry| entry.about.policy == FLOOR);
    let floor = floor.with_context(|| {
        format!("expected an entry of {FLOOR}, whose reward is score 0: add its results first")
    })?;
    let mut known = BTreeSet::new();
    for entry in entries {
        let policy = &*entry.about.policy;
        ensure!(
            known.insert(policy),
            "entry {policy}: expected one file, got several"
        );
        for task in tasks(&entry.runs) {
            let checked = check_worlds(policy, entry.on(task), &worlds(floor.on(task)));
            let [expected, got] = [floor, entry].map(|entry| teams(entry.on(task)));
            let checked = checked.and_then(|()| {
                ensure!(
                    policy != CEILING || expected == got,
                    "expected team {expected}, as in the entry of {FLOOR}, got {got}"
                );
                Ok(())
            });
            checked.with_context(|| format!("entry {policy}, task {task}"))?;
        }
    }
    Ok(())
}

fn is_commit(text: &str) -> bool {
    (7..=40).contains(&text.len()) && text.bytes().all(|it| it.is_ascii_hexdigit())
}

/// Returns whether a text is safe in a Markdown table: without HTML, code, or links except web addresses.
fn is_plain(text: &str) -> bool {
    let address = ["https://", "http://"];
    let rest = address.iter().find_map(|scheme| text.strip_prefix(scheme));
    let is_allowed = |it: char| it.is_alphanumeric() || " .,'-_&()@+/#?=%~".contains(it);
    (1..=200).contains(&text.len()) && rest.unwrap_or(text).chars().all(is_allowed)
}

/// Renders the page: one row per entry, the best first; then entries that lack a task; then each task's scores.
pub fn render_page(entries: &[Entry]) -> String {
    let runs = all_runs(entries);
    let n_tasks = tasks(&runs).len();
    let (mut complete, mut partial) = (Vec::new(), Vec::new());
    for (policy, score) in by_score(&runs) {
        let entry = entries.iter().find(|entry| entry.about.policy == policy);
        let Entry { about, runs } = entry.expect("invariant: each policy is an entry's");
        let (rows, result) = match score {
            Some(score) => (&mut complete, score_text(score)),
            None => (&mut partial, format!("{} of {n_tasks}", tasks(runs).len())),
        };
        rows.push(vec![
            policy.into(),
            result,
            teams(runs.iter().filter(|run| run.robots > 1)),
            number(about.training_seconds.unwrap_or_default(), 0),
            about.by.clone(),
            about.code.clone(),
            about.commit.clone(),
        ]);
    }
    let headings = |result| {
        [
            "policy",
            result,
            "team",
            "training, s",
            "by",
            "code",
            "commit",
        ]
    };
    let mut parts = table("", &headings(SCORE), complete);
    parts.extend(table(PARTIAL, &headings("tasks"), partial));
    parts.push(render_suite(&runs));
    parts.retain(|part| !part.is_empty());
    parts.join("\n\n")
}

/// Returns the runs of all entries.
pub fn all_runs(entries: &[Entry]) -> Vec<PolicyRun> {
    entries
        .iter()
        .flat_map(|entry| entry.runs.clone())
        .collect()
}

fn teams<'a>(runs: impl Iterator<Item = &'a PolicyRun>) -> String {
    let teams: BTreeSet<&str> = runs.map(|run| &*run.team).collect();
    if teams.is_empty() {
        return NOTHING.into();
    }
    Vec::from_iter(teams).join(", ")
}
