//! Metrics of a training as CSV: one row per update, and one per step without updates.

use anyhow::{Context, Result, ensure};
use csv::StringRecord;
use emberwatch_acting::rollout::StepRecord;
use emberwatch_belief::estimation::scoring::Score;
use emberwatch_learning::learners::ModelUpdate;
use std::fs::File;
use std::path::{Path, PathBuf};

/// Name of the metrics file in the folder of a training.
pub const METRICS: &str = "metrics.csv";

const HEADER: [&str; 6] = [
    "update",
    "world_steps",
    "loss",
    "held_out_log_likelihood",
    "mean_reward",
    "rate",
];

/// Totals of one step of all robots.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Tick {
    /// World steps so far, summed over all robots.
    pub world_steps: u64,
    /// Number of robots that flew. Each counts as a separate world.
    pub n_worlds: u64,
    /// Sum of the robots' rewards.
    pub reward: f64,
    /// Score of the robots' frames under the predictions made before learning from them.
    pub score: Score,
}

impl Tick {
    /// Sums the records of all robots, after `world_steps` world steps.
    pub fn of(records: &[StepRecord], world_steps: u64) -> Self {
        let mut tick = Self {
            world_steps,
            n_worlds: records.len() as u64,
            ..Self::default()
        };
        for record in records {
            tick.reward += record.reward;
            tick.score += record.score.unwrap_or_default();
        }
        tick
    }
}

pub struct Metrics {
    path: PathBuf,
    writer: csv::Writer<File>,
}

impl Metrics {
    /// Creates the file. `more` names the learner's additional columns.
    pub fn create(path: &Path, more: &[&str]) -> Result<Self> {
        Self::write(path, more, &[]).with_context(|| of_file(path))
    }

    /// Reopens the file, or creates it if it is missing. Drops rows newer than the checkpoint, which was written at
    /// `world_steps`, and a last row cut short by a kill. Refuses a file with other columns.
    pub fn reopen(path: &Path, more: &[&str], world_steps: u64) -> Result<Self> {
        let reopen = || {
            let rows = kept_rows(path, more, world_steps)?;
            let temporary = path.with_extension("csv.new");
            let written = Self::write(&temporary, more, &rows)?;
            std::fs::rename(&temporary, path)?;
            anyhow::Ok(Self {
                path: path.to_owned(),
                ..written
            })
        };
        if path.exists() {
            reopen().with_context(|| of_file(path))
        } else {
            Self::create(path, more)
        }
    }

    fn write(path: &Path, more: &[&str], rows: &[StringRecord]) -> Result<Self> {
        let mut writer = csv::Writer::from_path(path)?;
        writer.write_record(HEADER.iter().chain(more))?;
        rows.iter().try_for_each(|row| writer.write_record(row))?;
        writer.flush()?;
        let path = path.to_owned();
        Ok(Self { path, writer })
    }

    /// Adds a row for each update of a step.
    pub fn add(&mut self, tick: &Tick, updates: &[ModelUpdate]) -> Result<()> {
        let mut rows = updates.iter().map(|update| row(tick, update));
        rows.try_for_each(|row| self.writer.write_record(row))
            .with_context(|| of_file(&self.path))
    }

    pub fn flush(&mut self) -> Result<()> {
        let flushed = self.writer.flush();
        flushed.with_context(|| of_file(&self.path))
    }
}

fn of_file(path: &Path) -> String {
    format!("metrics {}", path.display())
}

fn reader(path: &Path) -> csv::Result<csv::Reader<File>> {
    csv::ReaderBuilder::new().flexible(true).from_path(path)
}

fn kept_rows(path: &Path, more: &[&str], world_steps: u64) -> Result<Vec<StringRecord>> {
    let mut reader = reader(path)?;
    let got = reader.headers()?;
    let expected = StringRecord::from_iter(HEADER.iter().chain(more));
    let names = |record: &StringRecord| record.iter().collect::<Vec<_>>().join(",");
    ensure!(
        *got == expected,
        "expected the columns {}, got {}",
        names(&expected),
        names(got)
    );
    let is_kept = |row: &StringRecord| {
        let step = row.get(1).and_then(|step| step.parse().ok());
        row.len() == expected.len() && step.is_some_and(|step: u64| step <= world_steps)
    };
    let rows: Vec<_> = reader.records().collect::<Result<_, _>>()?;
    Ok(rows.into_iter().filter(is_kept).collect())
}

fn row(tick: &Tick, update: &ModelUpdate) -> Vec<String> {
    let counts = [update.number, tick.world_steps].map(|count| count.to_string());
    // The shortest text that parses to the same number.
    let text = |number: f64| format!("{number:?}");
    let numbers = numbers(tick, update).map(|number| number.map_or(String::new(), text));
    counts.into_iter().chain(numbers).collect()
}

fn numbers<'a>(tick: &Tick, update: &'a ModelUpdate) -> impl Iterator<Item = Option<f64>> + 'a {
    let held_out = (tick.score.n_seen > 0).then(|| tick.score.mean());
    let mean_reward = tick.reward / tick.n_worlds.max(1) as f64;
    let numbers = [update.loss, held_out, Some(mean_reward), update.rate];
    numbers.into_iter().chain(update.more.iter().copied())
}

/// The rows of a metrics file as numbers.
#[derive(Debug, Clone, PartialEq)]
pub struct Rows {
    names: Vec<String>,
    rows: Vec<Vec<Option<f64>>>,
}

impl Rows {
    /// Reads the metrics file of a folder. Fields that are not numbers become `None`.
    pub fn read(folder: &Path) -> Result<Self> {
        let path = folder.join(METRICS);
        let read = || {
            let mut reader = reader(&path)?;
            let names = reader.headers()?.iter().map(String::from).collect();
            let numbers = |row: StringRecord| {
                row.iter()
                    .map(|field| field.parse().ok())
                    .collect::<Vec<_>>()
            };
            let rows = reader.records().map(|row| row.map(numbers));
            let rows = rows.collect::<Result<_, _>>()?;
            anyhow::Ok(Self { names, rows })
        };
        read().with_context(|| of_file(&path))
    }

    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// Returns a column with one entry per row. All entries of an unknown column are `None`.
    pub fn column(&self, name: &str) -> Vec<Option<f64>> {
        let at = self.names.iter().position(|known| known == name);
        let field = |row: &Vec<Option<f64>>| at.and_then(|at| row.get(at).copied().flatten());
        self.rows.iter().map(field).collect()
    }
}
