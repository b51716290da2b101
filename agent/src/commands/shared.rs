//! What several subcommands need: a server that may come, models by name, files and output.

use crate::benchmark::report::RunsFile;
use crate::client::info::wait_for_server;
use anyhow::{Context, Result, ensure};
use clap::Args;
use emberwatch_learning::file::check_replaceable;
use emberwatch_protocol::Model;
use emberwatch_protocol::built_in::listed;
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::task::Task;
use std::io::Write;
use std::ops::Range;
use std::path::Path;
use std::str::FromStr;
use std::time::Duration;

/// How long to wait for a server.
#[derive(Debug, Args)]
pub struct WaitFlag {
    /// Seconds to wait until the instance has a server; 0: not at all
    #[arg(long, value_name = "SECONDS", default_value = "10", value_parser = parse_seconds)]
    wait: Duration,
}

impl WaitFlag {
    /// Waits for the instance's server; returns whether to go on: not once `is_over`.
    pub fn for_server(&self, instance: &Instance, is_over: impl Fn() -> bool) -> Result<bool> {
        Ok(wait_for_server(instance, self.wait, is_over)?)
    }
}

/// Whether `--policies help` asks what policies there are.
pub fn asks_for_help(policies: &[String]) -> bool {
    policies.iter().any(|name| name == "help")
}

pub fn parse_seconds(text: &str) -> Result<Duration, String> {
    let seconds: f64 = text.parse().map_err(|_| "expected seconds, such as 60")?;
    let limit = Duration::try_from_secs_f64(seconds);
    limit.map_err(|error| format!("expected seconds, such as 60: {error}"))
}

/// Consecutive numbers, at least one.
pub fn parse_range<T: FromStr + PartialOrd>(text: &str) -> Result<Range<T>, String> {
    let parsed = text
        .split_once("..")
        .and_then(|(first, end)| Some(first.parse().ok()?..end.parse().ok()?));
    let range: Range<T> = parsed.ok_or("expected FIRST..END, such as 0..8")?;
    if range.is_empty() {
        Err("expected FIRST below END".into())
    } else {
        Ok(range)
    }
}

/// A built-in model, or that of a file.
pub fn model_named(name: &str) -> Result<Model> {
    if let Some(model) = Model::built_in(name) {
        return Ok(model);
    }
    let path = Path::new(name);
    ensure!(
        path.exists(),
        "model file {name}: No such file: expected one, or {}",
        listed(Model::built_in_names())
    );
    read_model(path)
}

/// The model of a task that has one, with the task's sensor.
pub fn model_of(task: &Task) -> Result<Model> {
    with_sensor(model_named(&task.model)?, task.radius())
}

/// A model whose robots see so many rows and columns beyond their path; `None`: as it says.
pub fn with_sensor(model: Model, radius: Option<usize>) -> Result<Model> {
    Ok(match radius {
        Some(radius) => model.with_radius(radius)?,
        None => model,
    })
}

pub fn read_model(path: &Path) -> Result<Model> {
    Model::read(path).with_context(|| format!("model file {}", path.display()))
}

/// Makes the folder of a file to come.
pub fn make_folder_of(path: &Path) -> Result<()> {
    let parent = path.parent().filter(|parent| *parent != Path::new(""));
    parent.map_or(Ok(()), make_folder)
}

/// Makes a folder of files to come, and checks that it can be written to.
pub fn make_folder(path: &Path) -> Result<()> {
    let expected = "expected a folder that can be written to, or a path where one can be made";
    std::fs::create_dir_all(path)
        .map_err(Into::into)
        .and_then(|()| check_replaceable(&path.join("file")))
        .with_context(|| format!("create {}: {expected}", path.display()))
}

/// Locks the file of `--csv` until it is written, and makes its folder: better to fail before hours of work than after.
pub fn lock_csv(path: Option<&Path>) -> Result<Option<RunsFile>> {
    let lock = |path: &Path| {
        make_folder_of(path).with_context(|| path.display().to_string())?;
        RunsFile::lock(path, Duration::ZERO)
    };
    path.map(lock).transpose().context("--csv")
}

pub fn write(text: &str) -> Result<()> {
    let mut out = std::io::stdout();
    out.write_all(text.as_bytes())
        .and_then(|()| out.write_all(b"\n"))
        .context("write to standard output")
}
