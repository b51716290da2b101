//! The server's settings and their checks.

use crate::states_file::{StatesError, StatesFile};
use crate::world::{Recorded, Start};
use protocol::channels::{ChannelError, Instance, MAX_ROBOT_NUMBERS, MAX_ROBOTS, MAX_TEAM_CELLS};
use protocol::control::CoverageRule;
use protocol::grid::ShapeError;
use protocol::model::ModelError;
use protocol::path::MAX_MOVES;
use protocol::program::read_text;
use protocol::{Model, Shape};
use serde::{Deserialize, Serialize};
use std::fmt::Display;
use std::path::Path;
use std::sync::Arc;
use thiserror::Error;

/// Most worlds of one server.
const MAX_WORLDS: u32 = 1024;

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
    /// Robots of each world, 1 to 64; at most 4096 in all worlds together.
    pub robots: u32,
    /// How long a world waits for the paths of its other held robots from the first path on, milliseconds; 0: no
    /// deadline.
    pub deadline_millis: u64,
    /// A built-in model (`wildfire`, `wildfire-sparse`, `wildfire-latent`, `wildfire-small`,
    /// `wildfire-burnout`), or the path of a model file.
    pub model: String,
    /// A states file: worlds show its sequences, and model, grid and burn-in are not used; empty: none.
    pub states: String,
    /// Whether seeds also choose among the symmetries of the grid.
    pub states_symmetries: bool,
    /// Largest recorded step with which an episode begins; each seed draws its own.
    pub states_offset: u64,
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
    /// The robots' first cells: `corner` (each in another), `centre`, `random`, or `{ row = R, col = C }`.
    pub start: Start,
    /// Publish the hidden states, for evaluation and pictures.
    pub publish_truth: bool,
    /// Tell clients the model, so that they can run the known-model filter.
    pub reveal_model: bool,
    /// A lease ends this long after its last use, milliseconds, unless its client asks otherwise.
    pub lease_millis: u64,
    /// Threads that simulate; 0: one per core.
    pub threads: usize,
    /// Steps of each world whose frames are kept for later agents, 1 to 1,000,000.
    pub history: u32,
    /// Start with the worlds of this snapshot file, or of the last in this folder; empty: with new ones.
    pub restore: String,
    /// Steps of each world between two snapshots; 0: none are written.
    pub snapshot_every: u64,
    /// The folder for these snapshots.
    pub snapshot_dir: String,
    /// How many of them to keep, at least 1; the last that survives a loss of power is kept too.
    pub snapshot_keep: u32,
}

/// Settings that were checked, and what they name.
#[derive(Debug, Clone)]
pub struct Checked {
    pub config: ServerConfig,
    pub instance: Instance,
    /// Of recorded worlds an unchanging one.
    pub model: Model,
    pub shape: Shape,
    pub recorded: Option<CheckedStates>,
}

/// What recorded worlds show.
#[derive(Debug, Clone)]
pub struct CheckedStates {
    /// Their description in TOML.
    pub description: String,
    /// CRC-32 of the sequences.
    pub checksum: u32,
    pub recorded: Arc<Recorded>,
}

/// Why settings were refused.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// `what` is `config file` or `model file`.
    #[error("{what} {path}: {problem}")]
    File {
        what: &'static str,
        path: String,
        problem: String,
    },
    /// A setting out of its range.
    #[error("{setting}: expected {expected}, got {got}")]
    Range {
        setting: &'static str,
        expected: String,
        got: String,
    },
    #[error(transparent)]
    Channel(#[from] ChannelError),
    #[error(transparent)]
    Shape(#[from] ShapeError),
    #[error(transparent)]
    Model(#[from] ModelError),
    #[error(transparent)]
    States(#[from] StatesError),
}

impl Default for ServerConfig {
    fn default() -> Self {
        Self {
            instance: "default".into(),
            worlds: 1,
            robots: 1,
            deadline_millis: 0,
            model: WILDFIRE.into(),
            states: String::new(),
            states_symmetries: false,
            states_offset: 0,
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

impl ServerConfig {
    /// Checks every setting; a states file decides model, grid and burn-in.
    ///
    /// # Errors
    /// If a setting is wrong; the error names the first, what it must be and what it is.
    pub fn check(mut self) -> Result<Checked, ConfigError> {
        let instance = Instance::new(&self.instance)?;
        self.check_ranges()?;
        let (model, recorded) = match self.states.is_empty() {
            true => (None, None),
            false => self
                .read_states()
                .map(|(model, it)| (Some(model), Some(it)))?,
        };
        let shape = Shape::new(self.height, self.width)?;
        self.check_robots(shape)?;
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
        let model = model.map_or_else(|| self.read_model(), Ok)?;
        model.check_on(shape)?;
        Ok(Checked {
            config: self,
            instance,
            model,
            shape,
            recorded,
        })
    }

    fn check_ranges(&self) -> Result<(), ConfigError> {
        in_range("worlds", u64::from(self.worlds), 1, u64::from(MAX_WORLDS))?;
        in_range("moves", self.moves as u64, 1, MAX_MOVES as u64)?;
        in_range("lease_millis", self.lease_millis, 100, 86_400_000)?;
        in_range("threads", self.threads as u64, 0, 256)?;
        in_range("burn_in", self.burn_in, 0, 1 << 40)?;
        in_range("history", self.history.into(), 1, 1_000_000)?;
        in_range("snapshot_keep", self.snapshot_keep.into(), 1, 1_000_000)?;
        let needs = |setting, expected: &str, got| {
            let expected = expected.into();
            Err(ConfigError::Range {
                setting,
                expected,
                got,
            })
        };
        if (self.snapshot_every == 0) != self.snapshot_dir.is_empty() {
            let got = format!("{} and {:?}", self.snapshot_every, self.snapshot_dir);
            return needs("snapshot_every and snapshot_dir", "both or neither", got);
        }
        if self.states.is_empty() && (self.states_symmetries || self.states_offset > 0) {
            let got = format!("{} and {}", self.states_symmetries, self.states_offset);
            let settings = "states_symmetries and states_offset";
            return needs(settings, "none without a states file", got);
        }
        Ok(())
    }

    fn check_robots(&self, shape: Shape) -> Result<(), ConfigError> {
        in_range("robots", self.robots.into(), 1, MAX_ROBOTS as u64)?;
        in_range("deadline_millis", self.deadline_millis, 0, 86_400_000)?;
        let (n_robots, n_cells) = (self.robots as u64, shape.n_cells() as u64);
        let n_all = u64::from(self.worlds) * n_robots;
        in_range("worlds times robots", n_all, 1, MAX_ROBOT_NUMBERS as u64)?;
        let most = MAX_TEAM_CELLS as u64;
        in_range("cells times robots", n_cells * n_robots, 1, most)
    }

    /// The settings of a TOML file.
    ///
    /// # Errors
    /// If it cannot be read or is malformed.
    pub fn read(path: &Path) -> Result<Self, ConfigError> {
        let wrong = |error: &dyn Display| file_error("config file", path, error);
        let text = read_text(path).map_err(|error| wrong(&error))?;
        toml::from_str(&text).map_err(|error| wrong(&error))
    }

    /// The states file, which decides some of the settings.
    fn read_states(&mut self) -> Result<(Model, CheckedStates), ConfigError> {
        let file = StatesFile::read(Path::new(&self.states))?;
        (self.height, self.width) = file.shape.dim();
        (self.burn_in, self.model) = (0, String::new());
        let checksum = file.sequences.checksum();
        let (symmetries, offset) = (self.states_symmetries, self.states_offset);
        let recorded = Recorded::new(file.sequences.arrays, file.shape, symmetries, offset);
        let recorded = recorded.map_err(|most| ConfigError::Range {
            setting: "states_offset",
            expected: format!("0 to {most}, as the shortest sequence allows"),
            got: offset.to_string(),
        })?;
        let description = toml::to_string(&file.description);
        let states = CheckedStates {
            description: description.expect("invariant: a description was read from TOML"),
            checksum,
            recorded: Arc::new(recorded),
        };
        Ok((file.model, states))
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

fn file_error(what: &'static str, path: &Path, problem: impl Display) -> ConfigError {
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

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::Cell;

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
        check(|c| c.robots = 65, "robots: expected 1 to 64, got 65");
        check(
            |c| (c.worlds, c.robots) = (1024, 5),
            "worlds times robots: expected 1 to 4096, got 5120",
        );
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
