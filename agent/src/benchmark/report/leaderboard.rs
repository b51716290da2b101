//! Entries of the leaderboard, a CSV file each, and the page that they make together.

use crate::benchmark::report::columns::markdown;
use crate::benchmark::report::figures::{Height, draw_bars};
use crate::benchmark::report::number::number;
use crate::benchmark::report::policy_run::{ALONE, Group, PolicyRun};
use crate::benchmark::report::statistics::Estimate;
use crate::benchmark::report::suite::{Aggregate, FLOOR, TaskRuns, by_score, render_suite, told};
use crate::file::{Readers, replace_file};
use anyhow::{Context, Result, ensure};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// One policy: who made it, how, and its reward of each world of each task.
#[derive(Debug, Clone)]
pub struct Entry {
    pub about: About,
    pub tasks: Vec<TaskRuns>,
}

/// What an entry says of itself.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct About {
    pub policy: String,
    pub by: String,
    /// Where its code is.
    pub code: String,
    pub commit: String,
    /// Processor seconds of training, of all tasks together.
    pub training_seconds: f64,
}

/// A line of an entry's file.
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
    mean_reward: f64,
    brier: Option<f64>,
    log_likelihood: Option<f64>,
}

impl Entry {
    /// Reads the file that [`Self::write`] wrote.
    pub fn read(path: &Path) -> Result<Self> {
        let rows = csv::Reader::from_path(path)?.into_deserialize();
        let rows = rows.collect::<Result<Vec<Row>, _>>()?;
        let abouts: Vec<About> = rows.iter().map(Row::about).collect();
        let about = abouts.first().context("expected rows, got none")?;
        ensure!(
            abouts.iter().all(|other| other == about),
            "expected one policy, maker, code, commit and time of training in all rows"
        );
        let mut tasks: Vec<TaskRuns> = Vec::new();
        for row in rows {
            ensure!(
                row.mean_reward.is_finite(),
                "mean_reward: expected finite numbers, got {}",
                row.mean_reward
            );
            match tasks.iter_mut().find(|task| task.task == row.task) {
                Some(task) => task.runs.push(row.run()),
                None => tasks.push(TaskRuns {
                    task: row.task.clone(),
                    runs: vec![row.run()],
                }),
            }
        }
        Ok(Self {
            about: about.clone(),
            tasks,
        })
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

    fn worlds(&self, task: &str) -> BTreeSet<(u64, u64)> {
        let tasks = self.tasks.iter().filter(|other| other.task == task);
        tasks
            .flat_map(|task| &task.runs)
            .map(|run| (run.world_seed, run.steps))
            .collect()
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
            mean_reward: run.mean_reward,
            brier: run.brier,
            log_likelihood: run.log_likelihood,
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
            robots: 1,
            team: ALONE.into(),
            world_seed: self.world_seed,
            steps: self.steps,
            mean_reward: self.mean_reward,
            brier: self.brier,
            log_likelihood: self.log_likelihood,
            ..PolicyRun::default()
        }
    }
}

/// All entries of a folder, by the names of their files.
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

/// Refuses entries of other worlds or steps of a task than the random walk's, two of one policy, and a world twice.
pub fn check_entries(entries: &[Entry]) -> Result<()> {
    let mut names = entries.iter().map(|entry| &*entry.about.policy);
    let floor = names.position(|name| name == FLOOR);
    let floor = &entries[floor.with_context(|| format!("expected an entry of {FLOOR}"))?];
    let mut known = BTreeSet::new();
    for entry in entries {
        let policy = &entry.about.policy;
        ensure!(
            known.insert(policy),
            "entry {policy}: expected one file of it, got more"
        );
        for TaskRuns { task, runs } in &entry.tasks {
            let worlds = entry.worlds(task);
            ensure!(
                worlds == floor.worlds(task),
                "entry {policy}: expected the worlds and steps of task {task} that {FLOOR} has"
            );
            ensure!(
                worlds.len() == runs.len(),
                "entry {policy}: expected each world of task {task} once"
            );
        }
    }
    Ok(())
}

/// The page: a row an entry, the best first, then each task's scores.
pub fn render_page(entries: &[Entry]) -> String {
    let tasks = merged(entries);
    let headings = [
        "policy",
        "score [95 %]",
        "training, s",
        "by",
        "code",
        "commit",
    ];
    let rows = by_score(&tasks).into_iter().map(|(policy, score)| {
        let score = told(score);
        let entry = entries.iter().find(|entry| entry.about.policy == policy);
        let about = &entry.expect("invariant: each policy is an entry's").about;
        let seconds = number(about.training_seconds, 0);
        vec![
            policy.into(),
            score,
            seconds,
            about.by.clone(),
            about.code.clone(),
            about.commit.clone(),
        ]
    });
    format!("{}\n\n{}", markdown(&headings, rows), render_suite(&tasks))
}

/// Draws each entry's score over tasks, with a mark for its mean of each task; of entries that lack tasks the marks alone.
pub fn draw_leaderboard(path: &Path, entries: &[Entry]) -> Result<()> {
    let tasks = merged(entries);
    let runs = entries.iter().flat_map(|entry| {
        let policy = &entry.about.policy;
        let any = entry.tasks.iter().flat_map(|task| &task.runs).next();
        let score = |(index, task): (usize, &TaskRuns)| {
            let mean = Estimate::of(&task.scores(policy))?.mean;
            Some(PolicyRun {
                world_seed: index as u64,
                mean_reward: mean,
                ..any?.clone()
            })
        };
        tasks
            .iter()
            .enumerate()
            .filter_map(score)
            .collect::<Vec<_>>()
    });
    let runs: Vec<PolicyRun> = runs.collect();
    if runs.is_empty() {
        return Ok(()); // of one end of the scale alone there are no scores
    }
    let scores: BTreeMap<&str, Option<Aggregate>> = by_score(&tasks).into_iter().collect();
    let height = |group: &Group<'_>| match scores.get(group.policy).copied().flatten() {
        Some(score) => Height {
            value: score.mean,
            ends: Some([score.low, score.high]),
            label: told(Some(score)),
        },
        None => Height {
            value: f64::NAN,
            ends: None,
            label: format!("{} of {} tasks", group.runs.len(), tasks.len()),
        },
    };
    let words = [
        "Score of each policy over tasks",
        "bars are interquartile means over tasks and worlds, whiskers 95 % intervals, dots means of single tasks",
        "score: 0 is a random walk's, 1 an oracle's",
    ];
    draw_bars(path, &runs, words, &height)
}

/// The tasks of the first entry and then those of others, each with the runs of all entries.
fn merged(entries: &[Entry]) -> Vec<TaskRuns> {
    let mut tasks: Vec<TaskRuns> = Vec::new();
    for own in entries.iter().flat_map(|entry| &entry.tasks) {
        match tasks.iter_mut().find(|task| task.task == own.task) {
            Some(task) => task.runs.extend(own.runs.iter().cloned()),
            None => tasks.push(own.clone()),
        }
    }
    tasks
}
