//! The server's settings: defaults, then a TOML file, then flags.

use crate::episode::Start;
use clap::{Args, ValueEnum};
use protocol::channels::Instance;
use protocol::control::CoverageRule;
use protocol::path::MAX_MOVES;
use protocol::program::read_text;
use protocol::{Cell, Model, Shape};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use thiserror::Error;

/// Most worlds of one server.
pub const MAX_WORLDS: u32 = 1024;

/// The name of the default model.
const WILDFIRE: &str = "wildfire";

/// Every setting; `config/server.toml` lists them with their defaults.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ServerConfig {
    /// Name under which clients find this server.
    pub instance: String,
    /// Number of independent worlds, 1 to 1024; world i starts from `seed + i`.
    pub worlds: u32,
    /// A built-in model (`wildfire`, `wildfire-sparse`, `wildfire-latent`), or the path of a model file.
    pub model: String,
    /// Grid height, cells.
    pub height: usize,
    /// Grid width, cells.
    pub width: usize,
    /// Moves in a path, 1 to 4096 (the paper's T).
    pub moves: usize,
    /// Seed of world 0.
    pub seed: u64,
    /// Steps simulated from the initial distribution before k = 0.
    pub burn_in: u64,
    /// Episode length in steps; 0: never truncated.
    pub max_steps: u64,
    /// What a step observes: `path`, `full`, or `client` (a step may ask for a full frame).
    pub coverage: CoverageRule,
    /// The robot's first cell: `corner`, `centre`, `random`, or `{ row = R, col = C }`.
    pub start: Start,
    /// Publish the hidden states, for evaluation and pictures.
    pub publish_truth: bool,
    /// Tell clients the model, so that they can run the known-model filter.
    pub reveal_model: bool,
    /// A lease ends this long after its last use, milliseconds, unless its client asks otherwise.
    pub lease_millis: u64,
    /// Threads that simulate; 0: one per core.
    pub threads: usize,
    /// Steps of each world whose frames are kept for agents that come later, 1 to 1,000,000.
    pub history: u32,
    /// Begin with the worlds of this snapshot file, or of the last in this folder; empty: anew.
    pub restore: String,
    /// Write a snapshot each so many steps of all worlds together, times their number; 0: never.
    pub snapshot_every: u64,
    /// The folder for these snapshots.
    pub snapshot_dir: String,
    /// How many of them to keep, at least 1; the last that outlives a loss of power is kept besides.
    pub snapshot_keep: u32,
}

/// The same settings as flags; each overrides the file.
#[derive(Debug, Default, Args)]
pub struct ServerFlags {
    /// Read settings from this TOML file
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Name under which clients find this server [default: default]
    #[arg(long)]
    pub instance: Option<String>,
    /// Number of independent worlds [default: 1]
    #[arg(long)]
    pub worlds: Option<u32>,
    /// `wildfire`, `wildfire-sparse`, `wildfire-latent` or the path of a model file [default: wildfire]
    #[arg(long)]
    pub model: Option<String>,
    /// Grid height in cells [default: 64]
    #[arg(long)]
    pub height: Option<usize>,
    /// Grid width in cells [default: 64]
    #[arg(long)]
    pub width: Option<usize>,
    /// Moves in a path [default: 64]
    #[arg(long)]
    pub moves: Option<usize>,
    /// Seed of world 0; world i starts from this plus i [default: 0]
    #[arg(long)]
    pub seed: Option<u64>,
    /// Steps simulated before k = 0 [default: 10000]
    #[arg(long)]
    pub burn_in: Option<u64>,
    /// Episode length in steps, 0 for no end [default: 0]
    #[arg(long)]
    pub max_steps: Option<u64>,
    /// What a step observes [default: path]
    #[arg(long)]
    pub coverage: Option<CoverageFlag>,
    /// The robot's first cell: corner, centre, random or ROW,COL [default: corner]
    #[arg(long, value_parser = parse_start)]
    pub start: Option<Start>,
    /// Publish the hidden states, for evaluation and pictures
    #[arg(long, num_args = 0..=1, default_missing_value = "true", value_name = "BOOL")]
    pub publish_truth: Option<bool>,
    /// Tell clients the model [default: true]
    #[arg(long, num_args = 0..=1, default_missing_value = "true", value_name = "BOOL")]
    pub reveal_model: Option<bool>,
    /// A lease ends this long after its last use, in milliseconds [default: 30000]
    #[arg(long)]
    pub lease_millis: Option<u64>,
    /// Threads that simulate, 0 for one per core [default: 0]
    #[arg(long)]
    pub threads: Option<usize>,
    /// Steps of each world whose frames are kept for agents that come later [default: 256]
    #[arg(long)]
    pub history: Option<u32>,
    /// Begin with the worlds of this snapshot file, or of the last in this folder, if there is one
    #[arg(long, value_name = "FILE|FOLDER")]
    pub restore: Option<String>,
    /// Write a snapshot each so many steps of all worlds, and one at the end [default: 0, never]
    #[arg(long, value_name = "STEPS")]
    pub snapshot_every: Option<u64>,
    /// The folder for these snapshots
    #[arg(long, value_name = "FOLDER")]
    pub snapshot_dir: Option<String>,
    /// How many of these snapshots to keep, and the last that the disk has for sure [default: 3]
    #[arg(long)]
    pub snapshot_keep: Option<u32>,
}

/// [`CoverageRule`] as a flag.
#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum CoverageFlag {
    /// The cells on the path
    Path,
    /// Every cell
    Full,
    /// The cells on the path, or every cell when a step asks for it
    Client,
}

/// Settings that were checked, and what they name.
#[derive(Debug, Clone)]
pub struct Checked {
    /// The settings.
    pub config: ServerConfig,
    /// The instance.
    pub instance: Instance,
    /// The model.
    pub model: Model,
    /// The grid.
    pub shape: Shape,
}

/// Why settings were refused.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// A file that cannot be read.
    #[error("{what} {path}: {problem}")]
    File {
        /// `config file` or `model file`.
        what: &'static str,
        /// Its path.
        path: String,
        /// What is wrong.
        problem: String,
    },
    /// A setting out of its range.
    #[error("{setting}: expected {expected}, got {got}")]
    Range {
        /// Which setting.
        setting: &'static str,
        /// What it must be.
        expected: String,
        /// What it is.
        got: String,
    },
    /// A name, a shape or a model that its own check refused.
    #[error(transparent)]
    Channel(#[from] protocol::channels::ChannelError),
    /// See [`protocol::grid::ShapeError`].
    #[error(transparent)]
    Shape(#[from] protocol::grid::ShapeError),
    /// See [`protocol::model::ModelError`].
    #[error(transparent)]
    Model(#[from] protocol::model::ModelError),
}

impl Default for ServerConfig {
    fn default() -> Self {
        Self {
            instance: "default".into(),
            worlds: 1,
            model: WILDFIRE.into(),
            height: 64,
            width: 64,
            moves: 64,
            seed: 0,
            burn_in: 10_000,
            max_steps: 0,
            coverage: CoverageRule::Path,
            start: Start::Corner,
            publish_truth: false,
            reveal_model: true,
            lease_millis: 30_000,
            threads: 0,
            history: 256,
            restore: String::new(),
            snapshot_every: 0,
            snapshot_dir: String::new(),
            snapshot_keep: 3,
        }
    }
}

impl ServerFlags {
    /// The effective settings.
    ///
    /// # Errors
    /// [`ConfigError::File`] for a file that is not there or not of the form.
    pub fn effective(&self) -> Result<ServerConfig, ConfigError> {
        let mut config = match &self.config {
            None => ServerConfig::default(),
            Some(path) => toml::from_str(&read("config file", path)?)
                .map_err(|error| file_error("config file", path, error))?,
        };
        fn set<T: Clone>(setting: &mut T, flag: &Option<T>) {
            if let Some(value) = flag {
                *setting = value.clone();
            }
        }
        set(&mut config.instance, &self.instance);
        set(&mut config.worlds, &self.worlds);
        set(&mut config.model, &self.model);
        set(&mut config.height, &self.height);
        set(&mut config.width, &self.width);
        set(&mut config.moves, &self.moves);
        set(&mut config.seed, &self.seed);
        set(&mut config.burn_in, &self.burn_in);
        set(&mut config.max_steps, &self.max_steps);
        set(&mut config.coverage, &self.coverage.map(CoverageRule::from));
        set(&mut config.start, &self.start);
        set(&mut config.publish_truth, &self.publish_truth);
        set(&mut config.reveal_model, &self.reveal_model);
        set(&mut config.lease_millis, &self.lease_millis);
        set(&mut config.threads, &self.threads);
        set(&mut config.history, &self.history);
        set(&mut config.restore, &self.restore);
        set(&mut config.snapshot_every, &self.snapshot_every);
        set(&mut config.snapshot_dir, &self.snapshot_dir);
        set(&mut config.snapshot_keep, &self.snapshot_keep);
        Ok(config)
    }
}

impl ServerConfig {
    /// Checks every setting.
    ///
    /// # Errors
    /// [`ConfigError`] names the first setting that is wrong, what it must be and what it is.
    pub fn check(self) -> Result<Checked, ConfigError> {
        let instance = Instance::new(&self.instance)?;
        let shape = Shape::new(self.height, self.width)?;
        in_range("worlds", u64::from(self.worlds), 1, u64::from(MAX_WORLDS))?;
        in_range("moves", self.moves as u64, 1, MAX_MOVES as u64)?;
        in_range("lease_millis", self.lease_millis, 100, 86_400_000)?;
        in_range("threads", self.threads as u64, 0, 256)?;
        in_range("burn_in", self.burn_in, 0, 1 << 40)?;
        in_range("history", self.history.into(), 1, 1_000_000)?;
        in_range("snapshot_keep", self.snapshot_keep.into(), 1, 1_000_000)?;
        if (self.snapshot_every == 0) != self.snapshot_dir.is_empty() {
            let got = format!("{} and {:?}", self.snapshot_every, self.snapshot_dir);
            return Err(ConfigError::Range {
                setting: "snapshot_every and snapshot_dir",
                expected: "both or neither".into(),
                got,
            });
        }
        if let Start::At(cell) = self.start
            && !shape.contains(cell)
        {
            let expected = format!("a cell on the {shape} grid");
            return Err(ConfigError::Range {
                setting: "start",
                expected,
                got: cell.to_string(),
            });
        }
        let model = self.read_model()?;
        model.check_on(shape)?;
        Ok(Checked {
            config: self,
            instance,
            model,
            shape,
        })
    }

    fn read_model(&self) -> Result<Model, ConfigError> {
        if let Some(model) = Model::built_in(&self.model) {
            return Ok(model);
        }
        let path = Path::new(&self.model);
        let text = read_text(path).map_err(|error| {
            let names: Vec<&str> = Model::built_in_names().collect();
            let problem = format!("{error}: expected one, or {}", names.join(", "));
            file_error("model file", path, problem)
        })?;
        Model::from_toml(&text).map_err(|error| file_error("model file", path, error))
    }
}

fn read(what: &'static str, path: &Path) -> Result<String, ConfigError> {
    read_text(path).map_err(|error| file_error(what, path, error))
}

fn file_error(what: &'static str, path: &Path, problem: impl ToString) -> ConfigError {
    ConfigError::File {
        what,
        path: path.display().to_string(),
        problem: problem.to_string(),
    }
}

fn in_range(setting: &'static str, got: u64, least: u64, most: u64) -> Result<(), ConfigError> {
    if (least..=most).contains(&got) {
        return Ok(());
    }
    Err(ConfigError::Range {
        setting,
        expected: format!("{least} to {most}"),
        got: got.to_string(),
    })
}

fn parse_start(text: &str) -> Result<Start, String> {
    match text {
        "corner" => Ok(Start::Corner),
        "centre" => Ok(Start::Centre),
        "random" => Ok(Start::Random),
        cell => {
            let parsed = cell
                .split_once(',')
                .and_then(|(row, col)| Some((row.trim().parse().ok()?, col.trim().parse().ok()?)));
            let (row, col) = parsed.ok_or("expected corner, centre, random or ROW,COL")?;
            Ok(Start::At(Cell { row, col }))
        }
    }
}

impl From<CoverageFlag> for CoverageRule {
    fn from(flag: CoverageFlag) -> Self {
        match flag {
            CoverageFlag::Path => Self::Path,
            CoverageFlag::Full => Self::Full,
            CoverageFlag::Client => Self::Client,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_documented_file_holds_the_defaults() {
        let text = include_str!("../../config/server.toml");
        assert_eq!(
            toml::from_str::<ServerConfig>(text).ok(),
            Some(ServerConfig::default())
        );
        let n_settings = toml::Table::try_from(ServerConfig::default())
            .expect("serialises")
            .len();
        assert_eq!(
            text.parse::<toml::Table>().expect("TOML").len(),
            n_settings,
            "a setting is not listed"
        );
    }

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

    fn check(change: impl FnOnce(&mut ServerConfig), expected: &str) {
        let mut config = ServerConfig::default();
        change(&mut config);
        let error = config.check().expect_err("must be refused").to_string();
        assert!(
            error.contains(expected),
            "{error:?} does not say {expected:?}"
        );
    }

    #[test]
    fn wrong_settings_are_named() {
        check(|c| c.worlds = 0, "worlds: expected 1 to 1024, got 0");
        check(|c| c.moves = 4097, "moves: expected 1 to 4096, got 4097");
        check(|c| c.height = 0, "height and width in 1..=4096, got 0 x 64");
        check(|c| c.instance = "a b".into(), "instance name");
        check(
            |c| c.model = "no/such.toml".into(),
            "model file no/such.toml: ",
        );
        check(
            |c| c.start = Start::At(Cell { row: 64, col: 0 }),
            "start: expected a cell on the 64 x 64 grid, got (64, 0)",
        );
        check(|c| c.lease_millis = 1, "lease_millis");
    }
}
