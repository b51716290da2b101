//! The server's settings as flags.

use clap::{Args, ValueEnum, value_parser};
use emberwatch_protocol::Model;
use emberwatch_protocol::built_in::{listed, state_names};
use emberwatch_protocol::model::MAX_RADIUS;
use emberwatch_protocol::task::{Start, Task};
use emberwatch_sim::config::{ConfigError, ServerConfig};
use emberwatch_sim::given::start_of;
use serde::Serialize;
use serde_json::Value;
use std::path::PathBuf;

/// The settings of [`ServerConfig`] as flags. Each flag overrides the setting in the file.
#[derive(Debug, Default, Args, Serialize)]
pub struct ServerFlags {
    /// Read settings from this TOML file
    #[arg(long, value_name = "FILE")]
    #[serde(skip)]
    pub config: Option<PathBuf>,
    /// Name under which clients find this server [default: default]
    #[arg(long)]
    pub instance: Option<String>,
    /// Number of independent worlds [default: 1]
    #[arg(long)]
    pub worlds: Option<u32>,
    /// Number of robots in each world [default: 1]
    #[arg(long)]
    pub robots: Option<u32>,
    /// Maximum wait of a world for its robots' paths, in milliseconds after the first path, 0 for no limit [default: 0]
    #[arg(long, value_name = "MILLIS")]
    #[serde(rename = "deadline_millis")]
    pub deadline_ms: Option<u64>,
    #[arg(long, value_name = "NAME|FILE", help = format!(
        "Use the worlds of a task, which sets model or states, sensor, grid, moves, robots, burn-in, start and episode \
         length: {} or the path of a task file", listed(Task::built_in_names())))]
    pub task: Option<String>,
    #[arg(long, value_name = "NAME|FILE", help = format!(
        "Model of the worlds: {} or the path of a model file [default: wildfire]", listed(Model::built_in_names())))]
    pub model: Option<String>,
    #[arg(long, value_parser = value_parser!(u8).range(..=MAX_RADIUS as i64), help = format!(
        "Rows and columns that robots see around each cell of their path, 0 to {MAX_RADIUS} [default: the model's]"))]
    pub sensor_radius: Option<u8>,
    #[arg(long, value_name = "NAME|FILE|FOLDER", help = format!(
        "Show recorded states, which set model, grid and burn-in: {} or the path of a .npz or .npy file or of a folder",
        listed(state_names())))]
    pub states: Option<String>,
    /// Let seeds also select a symmetry of the grid
    #[arg(long, num_args = 0..=1, default_missing_value = "true", value_name = "BOOL")]
    pub states_symmetries: Option<bool>,
    /// Maximum recorded step at which an episode begins; the seed draws one from 0 to this [default: 0]
    #[arg(long, value_name = "STEPS")]
    pub states_offset: Option<u64>,
    /// Grid height in cells [default: 64]
    #[arg(long)]
    pub height: Option<usize>,
    /// Grid width in cells [default: 64]
    #[arg(long)]
    pub width: Option<usize>,
    /// Number of moves in a path [default: 64]
    #[arg(long)]
    pub moves: Option<usize>,
    /// Seed of world 0; world i starts from this seed plus i [default: 0]
    #[arg(long)]
    pub seed: Option<u64>,
    /// Number of steps simulated before k = 0 [default: 10000]
    #[arg(long)]
    pub burn_in: Option<u64>,
    /// Maximum episode length in steps, 0 for no limit [default: 0]
    #[arg(long)]
    pub max_steps: Option<u64>,
    /// Cells that a robot observes in a step [default: path]
    #[arg(long)]
    pub coverage: Option<CoverageFlag>,
    /// Start cells of robots: corner (a different one for each), centre, random or ROW,COL [default: corner]
    #[arg(long, value_parser = start_of)]
    pub start: Option<Start>,
    /// Publish the hidden states, for evaluation and display
    #[arg(long, num_args = 0..=1, default_missing_value = "true", value_name = "BOOL")]
    pub publish_truth: Option<bool>,
    /// Send clients the model [default: true]
    #[arg(long, num_args = 0..=1, default_missing_value = "true", value_name = "BOOL")]
    pub reveal_model: Option<bool>,
    /// Time from the last use of a lease until it ends, in milliseconds [default: 30000]
    #[arg(long)]
    pub lease_millis: Option<u64>,
    /// Number of threads that simulate, 0 for one per core [default: 0]
    #[arg(long)]
    pub threads: Option<usize>,
    /// Number of the latest steps of each world whose frames are kept for agents that take over [default: 256]
    #[arg(long)]
    pub history: Option<u32>,
    /// Start with the worlds of this snapshot file, or of the latest one in this folder, if there is one
    #[arg(long, value_name = "FILE|FOLDER")]
    pub restore: Option<String>,
    /// Number of steps, on average over the worlds, between two snapshots; another is written at the end [default: 0,
    /// never]
    #[arg(long, value_name = "STEPS")]
    pub snapshot_every: Option<u64>,
    /// Folder for these snapshots
    #[arg(long, value_name = "FOLDER")]
    pub snapshot_dir: Option<String>,
    /// Number of these snapshots to keep, in addition to the latest one that is safely on disk [default: 3]
    #[arg(long)]
    pub snapshot_keep: Option<u32>,
}

/// [`CoverageRule`](emberwatch_protocol::control::CoverageRule) as a flag.
#[derive(Debug, Clone, Copy, ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum CoverageFlag {
    /// The cells on the path
    Path,
    /// Every cell
    Full,
    /// The cells on the path, or every cell if the step request asks for it
    Client,
}

impl ServerFlags {
    /// Returns the effective settings: defaults, overridden by the file, overridden by flags.
    pub fn effective(&self) -> Result<ServerConfig, ConfigError> {
        let config = match &self.config {
            None => ServerConfig::default(),
            Some(path) => ServerConfig::read(path)?,
        };
        let mut given = match serde_json::to_value(self) {
            Ok(Value::Object(given)) => given,
            _ => unreachable!("invariant: flags serialise"),
        };
        given.retain(|_, value| !value.is_null());
        config.with(&given)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberwatch_protocol::Cell;

    #[test]
    fn flags_override_the_file_and_the_file_the_defaults() {
        let path =
            std::env::temp_dir().join(format!("emberwatch-config-{}.toml", std::process::id()));
        std::fs::write(
            &path,
            "worlds = 3\nmoves = 5\nstart = { row = 1, col = 2 }\n",
        )
        .expect("write");
        let flags = ServerFlags {
            config: Some(path.clone()),
            moves: Some(7),
            ..ServerFlags::default()
        };
        let config = flags.effective().expect("valid");
        assert_eq!((config.worlds, config.moves, config.height), (3, 7, 64));
        assert_eq!(config.start, Start::At(Cell { row: 1, col: 2 }));
        std::fs::write(&path, "wrolds = 3\n").expect("write");
        let error = flags.effective().expect_err("unknown key").to_string();
        assert!(error.contains("wrolds"), "{error}");
        std::fs::remove_file(&path).expect("clean up");
    }
}
