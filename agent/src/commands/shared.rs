//! Helpers of several subcommands: values of flags, and output files.

use crate::benchmark::report::runs_file::check_runs_file;
use anyhow::{Context, Result};
use emberwatch_learning::file::check_replaceable;
use emberwatch_network::Device;
use emberwatch_protocol::program::print;
use std::ops::Range;
use std::path::Path;
use std::str::FromStr;
use std::time::Duration;

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

/// Opens the device of `--device`.
pub fn open_device(name: &str) -> Result<Device> {
    emberwatch_network::open_device(name).map_err(anyhow::Error::msg)
}

pub fn write(text: &str) -> Result<()> {
    Ok(print(&format!("{text}\n"))?)
}
