//! Entries of the leaderboard, one CSV file each, and the page of all entries.

use crate::benchmark::report::columns::markdown;
use crate::benchmark::report::common_worlds::{World, check_worlds};
use crate::benchmark::report::number::{NOTHING, number};
use crate::benchmark::report::policy_run::PolicyRun;
use crate::benchmark::report::runs_file::csv_files;
use crate::benchmark::report::suite::{
    CEILING, FLOOR, PARTIAL, TaskRuns, by_completeness, by_score, render_suite, score_text,
};
use anyhow::{Context, Result, ensure};
use emberwatch_learning::file::{Readers, replace_file};
use emberwatch_protocol::task::is_file_name;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Characters allowed in plain text besides letters and digits.
const PUNCTUATION: &str = " .,'-_&()@+/#?=%~";

/// One policy: its origin, and its mean reward in each world of each task.
#[derive(Debug, Clone)]
pub struct Entry {
    pub about: About,
    pub tasks: Vec<TaskRuns>,
}

/// The origin of an entry's policy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct About {
    pub policy: String,
    pub by: String,
    /// Where to find the code.
    pub code: String,
    pub commit: String,
    /// Processor seconds of training, summed over all tasks.
    pub training_seconds: f64,
}

/// The columns of an entry's file; the first are those of [`About`].
const COLUMNS: &str = "policy,by,code,commit,training_seconds,estimator,task,world_seed,steps,robots,team,mean_reward,\
                       brier,log_likelihood,worlds_fingerprint";

impl Entry {
    /// Reads a file written by [`Self::write`].
    pub fn read(path: &Path) -> Result<Self> {
        let mut rows = csv::Reader::from_path(path)?;
        let columns = rows.headers()?.clone();
        let task = columns.iter().position(|name| name == "task");
        let task = task.context("expected a column task, got none")?;
        let mut abouts: Vec<About> = Vec::new();
        let mut tasks: Vec<TaskRuns> = Vec::new();
        for row in rows.records() {
            let row = row?;
            abouts.push(row.deserialize(Some(&columns))?);
            let run = row.deserialize(Some(&columns))?;
            add(&mut tasks, &row[task], vec![run]);
        }
        let about = abouts.pop().context("expected rows, got none")?;
        ensure!(
            abouts.iter().all(|other| *other == about),
            "expected the same policy, by, code, commit and training_seconds in all rows, got different ones"
        );
        let entry = Self { about, tasks };
        entry.check()?;
        Ok(entry)
    }

    /// Checks all texts and numbers, which come from flags or files, before they reach a page.
    pub fn check(&self) -> Result<()> {
        let about = &self.about;
        let policy = about.policy.replace(['/', '+'], "_");
        let tasks = self.tasks.iter().map(|task| ("task", &*task.task));
        for (what, name) in [("policy", &*policy)].into_iter().chain(tasks) {
            ensure!(
                is_file_name(name),
                "{what}: expected 1 to 64 letters, digits, '-', '_' and '.', for a policy also '/' and '+', got {name:?}"
            );
        }
        let columns = self
            .runs()
            .flat_map(|run| [("estimator", &run.estimator), ("team", &run.team)]);
        for (what, text) in [("by", &about.by), ("code", &about.code)]
            .into_iter()
            .chain(columns)
        {
            ensure!(
                is_plain(text),
                "{what}: expected 1 to 200 letters, digits, spaces and {}, or an address that begins with \
                 https://, got {text:?}",
                PUNCTUATION.trim_start()
            );
        }
        let commit = &about.commit;
        ensure!(
            (7..=40).contains(&commit.len()) && commit.bytes().all(|it| it.is_ascii_hexdigit()),
            "commit: expected 7 to 40 hexadecimal digits, got {commit:?}"
        );
        ensure!(
            (0.0..1e12).contains(&about.training_seconds),
            "training_seconds: expected 0 or more, got {}",
            about.training_seconds
        );
        for run in self.runs() {
            let numbers = [Some(run.mean_reward), run.brier, run.log_likelihood];
            ensure!(
                numbers.iter().flatten().all(|number| number.is_finite()),
                "world {}: expected finite numbers, got {numbers:?}",
                run.world_seed
            );
        }
        Ok(())
    }

    pub fn write(&self, path: &Path) -> Result<()> {
        let mut writer = csv::WriterBuilder::new()
            .has_headers(false)
            .from_writer(Vec::new());
        writer.write_record(COLUMNS.split(','))?;
        for TaskRuns { task, runs } in &self.tasks {
            for run in runs {
                let what = (&run.estimator, task, run.world_seed, run.steps);
                let who = (run.robots, &run.team);
                let scores = (run.mean_reward, run.brier, run.log_likelihood);
                writer.serialize((&self.about, what, who, scores, &run.worlds_fingerprint))?;
            }
        }
        replace_file(path, &writer.into_inner()?, Readers::Any)
    }

    fn runs(&self) -> impl Iterator<Item = &PolicyRun> {
        self.tasks.iter().flat_map(|task| &task.runs)
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
    for Entry { about, tasks } in entries {
        let policy = &*about.policy;
        ensure!(
            known.insert(policy),
            "entry {policy}: expected one file, got several"
        );
        for TaskRuns { task, runs } in tasks {
            let of_floor = floor.tasks.iter().find(|other| other.task == *task);
            let checked = of_floor
                .with_context(|| format!("expected this task in the entry of {FLOOR}, got none"))
                .and_then(|floor| check_runs(policy, runs, &floor.runs));
            checked.with_context(|| format!("entry {policy}, task {task}"))?;
        }
    }
    Ok(())
}

/// Checks an entry's runs on a task against the random walk's.
fn check_runs(policy: &str, runs: &[PolicyRun], floor: &[PolicyRun]) -> Result<()> {
    let worlds: BTreeSet<World> = floor.iter().map(World::of).collect();
    let runs_found: Vec<&PolicyRun> = runs.iter().collect();
    check_worlds(policy, &runs_found, &Vec::from_iter(worlds))?;
    let [expected, got] = [floor, runs].map(|runs| joined(runs.iter().map(|run| &*run.team)));
    ensure!(
        policy != CEILING || expected == got,
        "expected team {expected}, as in the entry of {FLOOR}, got {got}"
    );
    Ok(())
}

/// Returns whether a text is safe in a Markdown table: without HTML, code, or links except web addresses.
fn is_plain(text: &str) -> bool {
    let address = ["https://", "http://"];
    let rest = address.iter().find_map(|scheme| text.strip_prefix(scheme));
    (1..=200).contains(&text.len())
        && rest
            .unwrap_or(text)
            .chars()
            .all(|it| it.is_alphanumeric() || PUNCTUATION.contains(it))
}

/// Renders the page: one row per entry, the best first; then entries that lack a task; then each task's scores.
pub fn render_page(entries: &[Entry]) -> String {
    let tasks = merged(entries);
    let policies = by_score(&tasks);
    let (complete, partial) = by_completeness(&policies);
    let mut parts = Vec::new();
    for (words, heading, policies) in [("", "score [95 %]", complete), (PARTIAL, "tasks", partial)]
    {
        let rows = policies.iter().map(|&(policy, score)| {
            let entry = entries.iter().find(|entry| entry.about.policy == policy);
            let entry = entry.expect("invariant: each policy is an entry's");
            let about = &entry.about;
            vec![
                policy.into(),
                score.map_or_else(|| n_tasks(entry.tasks.len(), &tasks), score_text),
                teams(entry),
                number(about.training_seconds, 0),
                about.by.clone(),
                about.code.clone(),
                about.commit.clone(),
            ]
        });
        let headings = [
            "policy",
            heading,
            "team",
            "training, s",
            "by",
            "code",
            "commit",
        ];
        if rows.len() > 0 {
            parts.extend([words.to_owned(), markdown(&headings, rows).to_string()]);
        }
    }
    parts.push(render_suite(&tasks));
    parts.retain(|part| !part.is_empty());
    parts.join("\n\n")
}

/// Returns the kinds of team in which an entry's robots flew.
fn teams(entry: &Entry) -> String {
    let runs = entry.runs().filter(|run| run.robots > 1);
    match joined(runs.map(|run| &*run.team)) {
        teams if teams.is_empty() => NOTHING.into(),
        teams => teams,
    }
}

/// Lists names, each once.
fn joined<'a>(names: impl Iterator<Item = &'a str>) -> String {
    let names: BTreeSet<&str> = names.collect();
    Vec::from_iter(names).join(", ")
}

fn n_tasks(n: usize, tasks: &[TaskRuns]) -> String {
    format!("{n} of {}", tasks.len())
}

/// Merges the tasks of all entries, in order of first appearance, each with the runs of all entries.
pub(super) fn merged(entries: &[Entry]) -> Vec<TaskRuns> {
    let mut tasks = Vec::new();
    for own in entries.iter().flat_map(|entry| &entry.tasks) {
        add(&mut tasks, &own.task, own.runs.clone());
    }
    tasks
}

/// Adds runs to a task's other runs.
fn add(tasks: &mut Vec<TaskRuns>, task: &str, runs: Vec<PolicyRun>) {
    match tasks.iter_mut().find(|other| other.task == task) {
        Some(task) => task.runs.extend(runs),
        None => tasks.push(TaskRuns {
            task: task.into(),
            runs,
        }),
    }
}
