//! Helpers of several subcommands: waiting for a server, models by name, output files.

use crate::benchmark::report::runs_file::check_runs_file;
use crate::client::info::wait_for_server;
use anyhow::{Context, Result, ensure};
use clap::Args;
use emberwatch_learning::file::check_replaceable;
use emberwatch_protocol::Model;
use emberwatch_protocol::built_in::listed;
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::program::print;
use emberwatch_protocol::task::Task;
use std::ops::Range;
use std::path::Path;
use std::str::FromStr;
use std::time::Duration;

/// The flag `--wait`.
#[derive(Debug, Args)]
pub struct WaitFlag {
    /// Maximum seconds to wait for the instance's server; 0: do not wait
    #[arg(long, value_name = "SECONDS", default_value = "10", value_parser = parse_seconds)]
    wait: Duration,
}

impl WaitFlag {
    /// Waits for the instance's server. Returns false if `is_over` returned true first.
    pub fn for_server(&self, instance: &Instance, is_over: impl Fn() -> bool) -> Result<bool> {
        Ok(wait_for_server(instance, self.wait, is_over)?)
    }
}

/// Returns whether `--policies help` asks for the list of policies.
pub fn asks_for_help(policies: &[String]) -> bool {
    policies.iter().any(|name| name == "help")
}

pub fn parse_seconds(text: &str) -> Result<Duration, String> {
    let limit = text.parse().ok().map(Duration::try_from_secs_f64);
    let limit = limit.and_then(Result::ok);
    limit.ok_or("expected a number of seconds, such as 60".into())
}

/// Parses `FIRST..END`: at least one number, END excluded.
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

/// Returns a built-in model, or reads a model file.
pub fn model_named(name: &str) -> Result<Model> {
    if let Some(model) = Model::built_in(name) {
        return Ok(model);
    }
    let path = Path::new(name);
    ensure!(
        path.exists(),
        "model file {name}: No such file: expected a model file, or one of {}",
        listed(Model::built_in_names())
    );
    read_model(path)
}

/// Returns the model of a task with simulated worlds, with the task's sensor.
pub fn model_of(task: &Task) -> Result<Model> {
    with_sensor(model_named(&task.world.model)?, task.world.radius())
}

/// Returns a model whose robots see `radius` rows and columns beyond their path; `None` keeps the model's radius.
pub fn with_sensor(model: Model, radius: Option<usize>) -> Result<Model> {
    Ok(match radius {
        Some(radius) => model.with_radius(radius)?,
        None => model,
    })
}

pub fn read_model(path: &Path) -> Result<Model> {
    Model::read(path).with_context(|| format!("model file {}", path.display()))
}

/// Creates a folder for output files, and checks that it is writable.
pub fn make_folder(path: &Path) -> Result<()> {
    let expected = "expected a writable folder, or a path where one can be created";
    std::fs::create_dir_all(path)
        .map_err(Into::into)
        .and_then(|()| check_replaceable(&path.join("file")))
        .with_context(|| format!("create {}: {expected}", path.display()))
}

/// Creates the folder of the `--csv` file and checks that the file can be written, before the work begins.
pub fn check_csv(path: &Path) -> Result<()> {
    let parent = path.parent().filter(|parent| *parent != Path::new(""));
    let made = parent.map_or(Ok(()), make_folder);
    made.with_context(|| path.display().to_string())
        .and_then(|()| check_runs_file(path))
        .context("--csv")
}

pub fn write(text: &str) -> Result<()> {
    Ok(print(&format!("{text}\n"))?)
}
