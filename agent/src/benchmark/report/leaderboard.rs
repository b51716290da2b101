//! Entries of the leaderboard, one CSV file each, and the page of all entries.

use crate::benchmark::report::columns::markdown;
use crate::benchmark::report::common_worlds::CommonWorlds;
use crate::benchmark::report::number::{NOTHING, number};
use crate::benchmark::report::policy_run::PolicyRun;
use crate::benchmark::report::suite::{
    CEILING, FLOOR, PARTIAL, TaskRuns, by_completeness, by_score, render_suite, score_text,
};
use anyhow::{Context, Result, ensure};
use emberwatch_learning::file::{Readers, replace_file};
use emberwatch_protocol::task::is_file_name;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

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

/// A row of an entry's file.
#[derive(Serialize, Deserialize)]
struct Row {
    policy: String,
    by: String,
    code: String,
    commit: String,
    training_seconds: f64,
    estimator: String,
    task: String,
    world_seed: u64,
    steps: u64,
    /// Number of robots in the world.
    robots: u32,
    team: String,
    mean_reward: f64,
    brier: Option<f64>,
    log_likelihood: Option<f64>,
    #[serde(default)]
    worlds_fingerprint: String,
}

impl Entry {
    /// Reads a file written by [`Self::write`].
    pub fn read(path: &Path) -> Result<Self> {
        let rows = csv::Reader::from_path(path)?.into_deserialize();
        let rows = rows.collect::<Result<Vec<Row>, _>>()?;
        let abouts: Vec<About> = rows.iter().map(Row::about).collect();
        let about = abouts.first().context("expected rows, got none")?;
        ensure!(
            abouts.iter().all(|other| other == about),
            "expected the same policy, by, code, commit and training_seconds in all rows, got different ones"
        );
        let mut tasks: Vec<TaskRuns> = Vec::new();
        for row in rows {
            match tasks.iter_mut().find(|task| task.task == row.task) {
                Some(task) => task.runs.push(row.run()),
                None => tasks.push(TaskRuns {
                    task: row.task.clone(),
                    runs: vec![row.run()],
                }),
            }
        }
        let about = about.clone();
        let entry = Self { about, tasks };
        entry.check()?;
        Ok(entry)
    }

    /// Checks all texts and numbers, which come from flags or files, before they reach a page.
    pub fn check(&self) -> Result<()> {
        let About {
            policy,
            by,
            code,
            commit,
            training_seconds,
        } = &self.about;
        let tasks = self.tasks.iter().map(|task| ("task", &*task.task));
        for (what, name) in [("policy", &*file_stem(policy))].into_iter().chain(tasks) {
            ensure!(
                is_file_name(name),
                "{what}: expected 1 to 64 letters, digits, '-', '_' and '.', for a policy also '/' and '+', got {name:?}"
            );
        }
        let runs = || self.tasks.iter().flat_map(|task| &task.runs);
        let columns = runs().flat_map(|run| [("estimator", &run.estimator), ("team", &run.team)]);
        for (what, text) in [("by", by), ("code", code)].into_iter().chain(columns) {
            ensure!(
                is_plain(text),
                "{what}: expected 1 to 200 letters, digits, spaces and {}, or an address that begins with \
                 https://, got {text:?}",
                PUNCTUATION.trim_start()
            );
        }
        ensure!(
            (7..=40).contains(&commit.len()) && commit.bytes().all(|it| it.is_ascii_hexdigit()),
            "commit: expected 7 to 40 hexadecimal digits, got {commit:?}"
        );
        ensure!(
            (0.0..1e12).contains(training_seconds),
            "training_seconds: expected 0 or more, got {training_seconds}"
        );
        for run in runs() {
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
        let mut writer = csv::Writer::from_writer(Vec::new());
        for task in &self.tasks {
            let rows = task
                .runs
                .iter()
                .map(|run| Row::of(&self.about, &task.task, run));
            rows.into_iter().try_for_each(|row| writer.serialize(row))?;
        }
        replace_file(path, &writer.into_inner()?, Readers::Any)
    }

    fn of_task(&self, task: &str) -> Option<&TaskRuns> {
        self.tasks.iter().find(|other| other.task == task)
    }
}

impl Row {
    fn of(about: &About, task: &str, run: &PolicyRun) -> Self {
        let About {
            policy,
            by,
            code,
            commit,
            training_seconds,
        } = about.clone();
        Self {
            policy,
            by,
            code,
            commit,
            training_seconds,
            estimator: run.estimator.clone(),
            task: task.into(),
            world_seed: run.world_seed,
            steps: run.steps,
            robots: run.robots,
            team: run.team.clone(),
            mean_reward: run.mean_reward,
            brier: run.brier,
            log_likelihood: run.log_likelihood,
            worlds_fingerprint: run.worlds_fingerprint.clone(),
        }
    }

    fn about(&self) -> About {
        About {
            policy: self.policy.clone(),
            by: self.by.clone(),
            code: self.code.clone(),
            commit: self.commit.clone(),
            training_seconds: self.training_seconds,
        }
    }

    fn run(self) -> PolicyRun {
        PolicyRun {
            policy: self.policy,
            estimator: self.estimator,
            robots: self.robots,
            team: self.team,
            world_seed: self.world_seed,
            steps: self.steps,
            mean_reward: self.mean_reward,
            brier: self.brier,
            log_likelihood: self.log_likelihood,
            worlds_fingerprint: self.worlds_fingerprint,
            ..PolicyRun::default()
        }
    }
}

/// Reads all entries of a folder, in the order of their file names.
pub fn read_entries(folder: &Path) -> Result<Vec<Entry>> {
    let files = std::fs::read_dir(folder)
        .with_context(|| format!("expected a folder of entries at {}", folder.display()))?;
    let files = files
        .map(|file| Ok(file?.path()))
        .collect::<Result<BTreeSet<_>>>()?;
    let files = files
        .iter()
        .filter(|path| path.extension().is_some_and(|it| it == "csv"));
    let read = |path: &Path| Entry::read(path).with_context(|| format!("entry {}", path.display()));
    files.map(|path| read(path)).collect()
}

/// Returns the name of a policy's file without extension. The `/` and `+` of BELIEF/PLANNER/GOAL become `_`.
pub fn file_stem(policy: &str) -> String {
    policy.replace(['/', '+'], "_")
}

/// Checks that each entry has the same worlds as the random walk's entry, and that no policy has two entries.
pub fn check_entries(entries: &[Entry]) -> Result<()> {
    let mut all = entries.iter();
    let floor = all.find(|entry| entry.about.policy == FLOOR);
    let floor = floor.with_context(|| {
        format!("expected an entry of {FLOOR}, whose reward is score 0: add its results first")
    })?;
    let mut known = BTreeSet::new();
    check_scale(entries)?;
    for entry in entries {
        let policy = &entry.about.policy;
        ensure!(
            known.insert(policy),
            "entry {policy}: expected one file, got several"
        );
        for TaskRuns { task, runs } in &entry.tasks {
            let runs: Vec<&PolicyRun> = runs.iter().collect();
            let checked = worlds(floor, task).and_then(|worlds| worlds.check(policy, &runs));
            checked.with_context(|| format!("entry {policy}, task {task}"))?;
        }
    }
    Ok(())
}

/// Checks that the random walk and the oracle, which define the scale, were measured with the same kind of team.
fn check_scale(entries: &[Entry]) -> Result<()> {
    let teams = |name: &str| {
        let entry = entries.iter().find(|entry| entry.about.policy == name);
        let mut teams: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
        for TaskRuns { task, runs } in entry.iter().flat_map(|entry| &entry.tasks) {
            teams.insert(task, runs.iter().map(|run| &*run.team).collect());
        }
        teams
    };
    let floor = teams(FLOOR);
    for (task, got) in teams(CEILING) {
        let expected = floor.get(task).unwrap_or(&got);
        ensure!(
            *expected == got,
            "entry {CEILING}, task {task}: expected team {}, as in the entry of {FLOOR}, got {}",
            joined(expected),
            joined(&got)
        );
    }
    Ok(())
}

/// Returns a task's worlds in the random walk's entry.
fn worlds(floor: &Entry, task: &str) -> Result<CommonWorlds> {
    let runs = floor.of_task(task).map(|task| &task.runs);
    let runs =
        runs.with_context(|| format!("expected this task in the entry of {FLOOR}, got none"))?;
    let mut seeds: Vec<u64> = runs.iter().map(|run| run.world_seed).collect();
    seeds.sort_unstable();
    seeds.dedup();
    let fingerprint = &runs[0].worlds_fingerprint;
    ensure!(
        !fingerprint.is_empty(),
        "expected worlds_fingerprint in the entry of {FLOOR}, got none: run `suite` again, and add all entries anew"
    );
    Ok(CommonWorlds {
        fingerprint: Some(fingerprint.clone()),
        seeds,
        steps: runs[0].steps,
        moves: None,
        robots: Some(runs[0].robots),
        recent_steps: None,
    })
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
    let rows = by_score(&tasks).into_iter().map(|(policy, score)| {
        let entry = entries.iter().find(|entry| entry.about.policy == policy);
        let entry = entry.expect("invariant: each policy is an entry's");
        let about = &entry.about;
        let row = vec![
            policy.into(),
            score.map_or_else(|| n_tasks(entry.tasks.len(), &tasks), score_text),
            teams(entry),
            number(about.training_seconds, 0),
            about.by.clone(),
            about.code.clone(),
            about.commit.clone(),
        ];
        (score.is_some(), row)
    });
    let (complete, partial) = by_completeness(rows);
    let mut parts = Vec::new();
    for (words, heading, rows) in [("", "score [95 %]", complete), (PARTIAL, "tasks", partial)] {
        if !rows.is_empty() {
            let headings = [
                "policy",
                heading,
                "team",
                "training, s",
                "by",
                "code",
                "commit",
            ];
            let table = markdown(&headings, rows.into_iter()).to_string();
            parts.extend([words.to_owned(), table]);
        }
    }
    parts.push(render_suite(&tasks));
    parts.retain(|part| !part.is_empty());
    parts.join("\n\n")
}

/// Returns the kinds of team in which an entry's robots flew.
fn teams(entry: &Entry) -> String {
    let runs = entry.tasks.iter().flat_map(|task| &task.runs);
    let teams = runs.filter(|run| run.robots > 1).map(|run| &*run.team);
    let teams: BTreeSet<&str> = teams.collect();
    if teams.is_empty() {
        NOTHING.into()
    } else {
        joined(&teams)
    }
}

fn joined(names: &BTreeSet<&str>) -> String {
    let names: Vec<&str> = names.iter().copied().collect();
    names.join(", ")
}

fn n_tasks(n: usize, tasks: &[TaskRuns]) -> String {
    format!("{n} of {}", tasks.len())
}

/// Merges the tasks of all entries, in order of first appearance, each with the runs of all entries.
pub(super) fn merged(entries: &[Entry]) -> Vec<TaskRuns> {
    let mut tasks: Vec<TaskRuns> = Vec::new();
    for own in entries.iter().flat_map(|entry| &entry.tasks) {
        match tasks.iter_mut().find(|task| task.task == own.task) {
            Some(task) => task.runs.extend(own.runs.iter().cloned()),
            None => tasks.push(own.clone()),
        }
    }
    tasks
}
