//! `replay`: publishes a recording again.

use anyhow::{Context, Result};
use clap::Args;
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::program::stop_on_signals;
use emberwatch_server::recording::{ReplayOptions, replay};
use std::path::PathBuf;
use std::time::Duration;

/// Publishes a recording in the same way as the recorded server.
#[derive(Args)]
pub struct ReplayCommand {
    /// The recording to publish
    file: PathBuf,
    /// The instance to publish on
    #[arg(long, default_value = "default")]
    instance: String,
    /// Speed relative to the recording, or `max` for as fast as observers can follow
    #[arg(long, default_value = "1", value_parser = parse_speed, value_name = "FACTOR|max")]
    speed: Speed,
    /// Skip this many seconds at the beginning
    #[arg(long, default_value = "0", value_parser = parse_seconds, value_name = "SECONDS")]
    from: Duration,
    /// Restart at the end, until stopped
    #[arg(long = "loop")]
    repeat: bool,
    /// Start immediately instead of waiting for the first observer
    #[arg(long)]
    no_wait: bool,
    /// Refuse a damaged or truncated recording instead of replaying its intact records
    #[arg(long)]
    strict: bool,
}

/// Speed relative to the recording. `None` means as fast as observers can follow.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Speed(Option<f64>);

impl ReplayCommand {
    /// Replays until the end or until stopped.
    pub fn run(&self) -> Result<()> {
        let stop = stop_on_signals().context("handle signals")?;
        let options = ReplayOptions {
            file: self.file.clone(),
            instance: Instance::new(&self.instance)?,
            speed: self.speed.0,
            from: self.from,
            repeat: self.repeat,
            at_once: self.no_wait,
            strict: self.strict,
        };
        replay(&options, &stop)
    }
}

fn parse_speed(text: &str) -> Result<Speed, String> {
    match text.parse::<f64>() {
        _ if text == "max" => Ok(Speed(None)),
        Ok(factor) if factor.is_finite() && factor > 0.0 => Ok(Speed(Some(factor))),
        _ => Err("expected a number above 0, or max".into()),
    }
}

fn parse_seconds(text: &str) -> Result<Duration, String> {
    let seconds = text.parse::<f64>().ok();
    seconds
        .and_then(|seconds| Duration::try_from_secs_f64(seconds).ok())
        .ok_or_else(|| "expected a number of seconds, at least 0".into())
}
