//! The server's settings as flags.

use crate::config::{ConfigError, ServerConfig};
use clap::{Args, ValueEnum};
use emberwatch_protocol::Cell;
use emberwatch_protocol::control::CoverageRule;
use emberwatch_protocol::task::{Start, Task};
use std::path::PathBuf;

/// The settings of [`ServerConfig`] as flags; each overrides the file.
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
    /// Robots of each world [default: 1]
    #[arg(long)]
    pub robots: Option<u32>,
    /// How long a world waits for the paths of its other held robots from the first path on, in milliseconds, 0 for
    /// no deadline [default: 0]
    #[arg(long, value_name = "MILLIS")]
    pub deadline_ms: Option<u64>,
    /// Worlds of this task, which decides model or states, sensor, grid, moves, robots, burn-in, start and episodes:
    /// `wildfire`, `small`, `sparse`, `latent`, `burnout`, `terrain`, `road-ice`, `team`, `jacksboro` or the path of a
    /// task file
    #[arg(long, value_name = "NAME|FILE")]
    pub task: Option<String>,
    /// `wildfire`, `wildfire-sparse`, `wildfire-latent`, `wildfire-small`, `wildfire-burnout`, `wildfire-terrain`,
    /// `road-ice` or the path of a model file [default: wildfire]
    #[arg(long)]
    pub model: Option<String>,
    /// Rows and columns that robots see beyond each cell of their path, 0 to 8 [default: as the model says]
    #[arg(long, value_parser = clap::value_parser!(u8).range(0..=8))]
    pub sensor_radius: Option<u8>,
    /// Worlds show the recorded states of this .npz or .npy file or folder, or `jacksboro`, which decide model, grid and
    /// burn-in
    #[arg(long, value_name = "FILE|FOLDER")]
    pub states: Option<String>,
    /// Seeds choose among the symmetries of the grid, too
    #[arg(long, num_args = 0..=1, default_missing_value = "true", value_name = "BOOL")]
    pub states_symmetries: Option<bool>,
    /// Episodes begin at a recorded step of 0 to this, drawn from the seed [default: 0]
    #[arg(long, value_name = "STEPS")]
    pub states_offset: Option<u64>,
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
    /// The robots' first cells: corner (each in another), centre, random or ROW,COL [default: corner]
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
    /// Steps of each world whose frames are kept for later agents [default: 256]
    #[arg(long)]
    pub history: Option<u32>,
    /// Start with the worlds of this snapshot file, or of the last in this folder, if there is one
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

impl ServerFlags {
    /// The effective settings.
    pub fn effective(&self) -> Result<ServerConfig, ConfigError> {
        let mut config = match &self.config {
            None => ServerConfig::default(),
            Some(path) => ServerConfig::read(path)?,
        };
        fn set<T: Clone>(setting: &mut T, flag: &Option<T>) {
            if let Some(value) = flag {
                *setting = value.clone();
            }
        }
        set(&mut config.instance, &self.instance);
        set(&mut config.worlds, &self.worlds);
        set(&mut config.robots, &self.robots);
        set(&mut config.deadline_millis, &self.deadline_ms);
        set(&mut config.task, &self.task);
        set(&mut config.model, &self.model);
        set(
            &mut config.sensor_radius,
            &self.sensor_radius.map(i64::from),
        );
        set(&mut config.states, &self.states);
        set(&mut config.states_symmetries, &self.states_symmetries);
        set(&mut config.states_offset, &self.states_offset);
        if self.task.as_deref() == Some("") {
            Task::named("")?;
        }
        if !config.task.is_empty() {
            self.check_beside("a task", &[])?;
        } else if !config.states.is_empty() {
            let left = [
                "states",
                "sensor_radius",
                "states_symmetries",
                "states_offset",
                "moves",
                "robots",
                "max_steps",
                "start",
            ];
            self.check_beside("a states file", &left)?;
        }
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

    /// Refuses flags for what a task or recorded states decide; the settings in `left` are left to flags.
    fn check_beside(&self, what: &str, left: &[&str]) -> Result<(), ConfigError> {
        let text = |value: Option<u64>| value.map(|it| it.to_string());
        let of_worlds = [
            ("model", self.model.clone()),
            ("sensor_radius", text(self.sensor_radius.map(u64::from))),
            ("states", self.states.clone()),
            (
                "states_symmetries",
                self.states_symmetries.map(|it| it.to_string()),
            ),
            ("states_offset", text(self.states_offset)),
            ("height", text(self.height.map(|it| it as u64))),
            ("width", text(self.width.map(|it| it as u64))),
            ("moves", text(self.moves.map(|it| it as u64))),
            ("robots", text(self.robots.map(u64::from))),
            ("burn_in", text(self.burn_in)),
            ("max_steps", text(self.max_steps)),
            (
                "start",
                self.start.map(|it| format!("{it:?}").to_lowercase()),
            ),
        ];
        for (setting, got) in of_worlds {
            if let Some(got) = got.filter(|_| !left.contains(&setting)) {
                let expected = format!("no flag beside {what}, which decides it");
                return Err(ConfigError::Range {
                    setting,
                    expected,
                    got,
                });
            }
        }
        Ok(())
    }
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
