//! Metrics of a training as CSV: one row per update, and one per step without any.

use crate::scoring::Score;
use crate::student::Lesson;
use std::fs::OpenOptions;
use std::path::{Path, PathBuf};
use thiserror::Error;

/// The file's name in the folder of a training.
pub const METRICS: &str = "metrics.csv";

const HEADER: [&str; 6] = [
    "update",
    "world_steps",
    "loss",
    "held_out_log_likelihood",
    "mean_reward",
    "rate",
];

/// One step of all worlds.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Tick {
    /// World steps so far, of all worlds together.
    pub world_steps: u64,
    /// Worlds that made the step.
    pub n_worlds: u64,
    /// Sum of their rewards.
    pub reward: f64,
    /// How well their frames were predicted before anything was learned from them.
    pub score: Score,
}

/// A file that cannot be written.
#[derive(Debug, Error)]
#[error("metrics {}: {problem}", path.display())]
pub struct MetricsError {
    path: PathBuf,
    problem: csv::Error,
}

/// The open file.
pub struct Metrics {
    path: PathBuf,
    writer: csv::Writer<std::fs::File>,
    /// Columns of the learner's own.
    n_more: usize,
}

impl Metrics {
    /// Opens the file in a folder, to go on with it or anew. `more`: columns of the learner's own.
    ///
    /// # Errors
    /// [`MetricsError`].
    pub fn open(folder: &Path, more: &[&str], goes_on: bool) -> Result<Self, MetricsError> {
        let path = folder.join(METRICS);
        let goes_on = goes_on && path.exists();
        let mut options = OpenOptions::new();
        options.create(true).write(true);
        let file = match goes_on {
            true => options.append(true).open(&path),
            false => options.truncate(true).open(&path),
        };
        let fail = |problem: csv::Error| MetricsError {
            path: path.clone(),
            problem,
        };
        let mut writer = csv::Writer::from_writer(file.map_err(|error| fail(error.into()))?);
        if !goes_on {
            let header = HEADER.iter().chain(more);
            writer.write_record(header).map_err(fail)?;
        }
        let n_more = more.len();
        Ok(Self {
            path,
            writer,
            n_more,
        })
    }

    /// Adds a step's rows.
    ///
    /// # Errors
    /// [`MetricsError`].
    pub fn add(
        &mut self,
        tick: &Tick,
        lessons: &[Lesson],
        n_updates: u64,
    ) -> Result<(), MetricsError> {
        let nothing = Lesson {
            number: n_updates,
            loss: None,
            rate: None,
            more: vec![None; self.n_more],
        };
        let nothing = lessons.is_empty().then_some(&nothing);
        for lesson in lessons.iter().chain(nothing) {
            let written = self.writer.write_record(row(tick, lesson));
            written.map_err(|problem| self.fail(problem))?;
        }
        Ok(())
    }

    /// Writes what is still in memory.
    ///
    /// # Errors
    /// [`MetricsError`].
    pub fn flush(&mut self) -> Result<(), MetricsError> {
        let flushed = self.writer.flush();
        flushed.map_err(|problem| self.fail(problem.into()))
    }

    fn fail(&self, problem: csv::Error) -> MetricsError {
        let path = self.path.clone();
        MetricsError { path, problem }
    }
}

fn row(tick: &Tick, lesson: &Lesson) -> Vec<String> {
    let held_out = (tick.score.n_seen > 0).then(|| tick.score.mean());
    let mean_reward = tick.reward / tick.n_worlds.max(1) as f64;
    let numbers = [lesson.loss, held_out, Some(mean_reward), lesson.rate];
    let counts = [lesson.number, tick.world_steps].map(|count| count.to_string());
    let numbers = numbers.iter().chain(&lesson.more);
    // The shortest form that reads back as the same number.
    let numbers =
        numbers.map(|number| number.map_or(String::new(), |number| format!("{number:?}")));
    counts.into_iter().chain(numbers).collect()
}
