//! Metrics of a training as CSV: one row per update, and one per step without any.

use crate::estimator::learned_filter::Update;
use crate::scoring::Score;
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
}

impl Metrics {
    /// Opens the file in a folder, to go on with it or anew.
    ///
    /// # Errors
    /// [`MetricsError`].
    pub fn open(folder: &Path, goes_on: bool) -> Result<Self, MetricsError> {
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
            writer.write_record(HEADER).map_err(fail)?;
        }
        Ok(Self { path, writer })
    }

    /// Adds a step's rows.
    ///
    /// # Errors
    /// [`MetricsError`].
    pub fn add(
        &mut self,
        tick: &Tick,
        updates: &[Update],
        n_updates: u64,
    ) -> Result<(), MetricsError> {
        let rows = updates.iter().map(|update| {
            let (loss, rate) = (number(update.loss), number(update.rate));
            row(update.number, tick, loss, rate)
        });
        let without = row(n_updates, tick, String::new(), String::new());
        let without = updates.is_empty().then_some(without);
        for row in rows.chain(without) {
            let written = self.writer.write_record(row);
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

fn row(update: u64, tick: &Tick, loss: String, rate: String) -> [String; 6] {
    let held_out = match tick.score.n_seen {
        0 => String::new(),
        _ => number(tick.score.mean()),
    };
    [
        update.to_string(),
        tick.world_steps.to_string(),
        loss,
        held_out,
        number(tick.reward / tick.n_worlds.max(1) as f64),
        rate,
    ]
}

/// The shortest form that reads back as the same number.
fn number(value: f64) -> String {
    format!("{value:?}")
}
