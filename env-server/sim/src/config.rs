//! The server's settings and their checks.

use crate::bounds::BOUNDS;
use crate::states_file::{StatesError, StatesFile};
use crate::world::{Reach, Recorded};
use emberwatch_messages::capacity::{MAX_ROBOT_NUMBERS, MAX_TEAM_CELLS};
use emberwatch_messages::control::CoverageRule;
use emberwatch_messages::errors::ChannelError;
use emberwatch_messages::instance::Instance;
use emberwatch_model::ModelError;
use emberwatch_model::built_in::listed;
use emberwatch_model::grid::ShapeError;
use emberwatch_model::task::{Start, Task, TaskError};
use emberwatch_model::text::{parse_problem, read_text, shortened};
use emberwatch_model::{Model, Shape};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Number, Value};
use std::fmt::Display;
use std::path::Path;
use std::sync::Arc;
use thiserror::Error;

/// Name of the default model.
const WILDFIRE: &str = "wildfire";

/// All settings of a server. `config/server.toml` and the server's `flags.rs` explain each.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ServerConfig {
    pub instance: String,
    pub worlds: u32,
    pub robots: u32,
    pub deadline_millis: u64,
    pub task: String,
    pub model: String,
    pub sensor_radius: i64,
    pub states: String,
    pub states_symmetries: bool,
    pub states_offset: u64,
    pub height: usize,
    pub width: usize,
    pub moves: usize,
    pub seed: u64,
    pub burn_in: u64,
    pub max_steps: u64,
    pub coverage: CoverageRule,
    pub start: Start,
    pub publish_truth: bool,
    pub reveal_model: bool,
    pub lease_millis: u64,
    pub threads: usize,
    pub history: u32,
    pub restore: String,
    pub snapshot_every: u64,
    pub snapshot_dir: String,
    pub snapshot_keep: u32,
}

/// Checked settings, together with the model and the recorded states that were loaded for them.
#[derive(Debug, Clone)]
pub struct Checked {
    pub config: ServerConfig,
    pub instance: Instance,
    /// The task that set the worlds' settings, if any.
    pub task: Option<Task>,
    /// The model, which has no transitions if the worlds show recorded states.
    pub model: Model,
    pub shape: Shape,
    /// How many free cells no-fly cells cut off, and which fixed starts they enclose.
    pub reach: Reach,
    pub recorded: Option<CheckedStates>,
}

/// Recorded states after their checks.
#[derive(Debug, Clone)]
pub struct CheckedStates {
    /// The description file as TOML.
    pub description: String,
    /// CRC-32 of the sequences' shapes and values.
    pub checksum: u32,
    pub recorded: Arc<Recorded>,
}

/// An error in the settings.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// An error in a file. `what` names the kind of file: `config file` or `model file`.
    #[error("{what} {}: {problem}", shortened(path))]
    File {
        what: &'static str,
        path: String,
        problem: String,
    },
    /// A setting outside its range.
    #[error("{setting}: expected {expected}, got {got}")]
    Range {
        setting: &'static str,
        expected: String,
        got: String,
    },
    /// An error in a setting given by name ([`ServerConfig::with`]): the name is unknown, the value is invalid, or a
    /// task or a states file already determines the setting.
    #[error("{}: expected {expected}, got {}", shortened(setting), shortened(got))]
    Given {
        setting: String,
        expected: String,
        got: String,
    },
    #[error(transparent)]
    Task(#[from] TaskError),
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
            task: String::new(),
            model: WILDFIRE.into(),
            sensor_radius: -1,
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

impl Checked {
    /// Returns the same settings with another number of worlds.
    ///
    /// # Errors
    /// If there would be too many worlds, or too many robots in all worlds.
    pub fn with_worlds(mut self, worlds: u32) -> Result<Self, ConfigError> {
        self.config.worlds = worlds;
        self.config.check_ranges()?;
        self.config.check_robots(self.shape)?;
        Ok(self)
    }
}

impl ServerConfig {
    /// Checks all settings and loads the files named in them.
    ///
    /// A task replaces every setting that shapes the worlds. A states file replaces the model, the grid and the
    /// burn-in.
    pub fn check(mut self) -> Result<Checked, ConfigError> {
        let instance = Instance::new(&self.instance)?;
        let task = self.take_task()?;
        self.check_ranges()?;
        let (model, recorded) = if self.states.is_empty() {
            (None, None)
        } else {
            self.read_states()
                .map(|(model, it)| (Some(model), Some(it)))?
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
        let model = model.map_or_else(|| model_named(&self.model), Ok)?;
        let model = match usize::try_from(self.sensor_radius) {
            Ok(radius) => model.with_radius(radius)?,
            Err(_) => model,
        };
        let airspace = model.airspace(shape)?;
        let wrong = |[expected, got]: [String; 2]| ConfigError::Range {
            setting: "start",
            expected,
            got,
        };
        let reach = Reach::of(self.start, &airspace, self.robots as usize).map_err(wrong)?;
        Ok(Checked {
            config: self,
            instance,
            task,
            model,
            shape,
            reach,
            recorded,
        })
    }

    /// Copies the settings of the task, if there is one, and returns it.
    fn take_task(&mut self) -> Result<Option<Task>, ConfigError> {
        if self.task.is_empty() {
            return Ok(None);
        }
        let task = Task::named(&self.task)?;
        (self.model, self.states) = (task.model.clone(), task.states.clone());
        self.sensor_radius = task.sensor_radius;
        (self.states_symmetries, self.states_offset) = (task.states_symmetries, task.states_offset);
        (self.height, self.width) = (task.height, task.width);
        (self.moves, self.robots) = (task.moves, task.robots);
        (self.burn_in, self.max_steps, self.start) = (task.burn_in, task.max_steps, task.start);
        Ok(Some(task))
    }

    fn check_ranges(&self) -> Result<(), ConfigError> {
        let settings = self.values();
        // Skips height and width, because recorded states may still replace them. `Shape` checks both later.
        let bounds = BOUNDS
            .iter()
            .filter(|(it, ..)| !["height", "width"].contains(it));
        for &(setting, least, most) in bounds {
            let number = settings[setting].as_number().and_then(Number::as_i128);
            let number = number.expect("invariant: bounded settings are integers");
            in_range(setting, number, least, most)?;
        }
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
            return needs(settings, "false and 0 without a states file", got);
        }
        Ok(())
    }

    fn check_robots(&self, shape: Shape) -> Result<(), ConfigError> {
        let (n_robots, n_cells) = (i128::from(self.robots), shape.n_cells() as i128);
        let n_all = i128::from(self.worlds) * n_robots;
        in_range("worlds times robots", n_all, 1, MAX_ROBOT_NUMBERS as i128)?;
        let most = MAX_TEAM_CELLS as i128;
        in_range("cells times robots", n_cells * n_robots, 1, most)
    }

    /// Returns the settings by name.
    pub fn values(&self) -> Map<String, Value> {
        match serde_json::to_value(self) {
            Ok(Value::Object(values)) => values,
            _ => unreachable!("invariant: settings serialise"),
        }
    }

    /// Reads the settings from a TOML file.
    pub fn read(path: &Path) -> Result<Self, ConfigError> {
        let wrong = |error: &dyn Display| file_error("config file", path, error);
        let text = read_text(path).map_err(|error| wrong(&error))?;
        toml::from_str(&text).map_err(|error| wrong(&parse_problem(error)))
    }

    /// Reads the states file and replaces the settings that it determines: grid, burn-in and model.
    fn read_states(&mut self) -> Result<(Model, CheckedStates), ConfigError> {
        let file = StatesFile::named(&self.states)?;
        (self.height, self.width) = file.shape.dim();
        (self.burn_in, self.model) = (0, String::new());
        let checksum = file.sequences.checksum();
        let (symmetries, offset) = (self.states_symmetries, self.states_offset);
        let recorded = Recorded::new(file.sequences.arrays, file.shape, symmetries, offset)
            .map_err(|most| ConfigError::Range {
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
}

/// Returns the built-in model of this name, or the model of the file at this path. A text of several lines is itself
/// the text of a model file.
pub fn model_named(name: &str) -> Result<Model, ConfigError> {
    if let Some(model) = Model::built_in(name) {
        return Ok(model);
    }
    if name.contains('\n') {
        return Ok(Model::from_toml(name)?);
    }
    let path = Path::new(name);
    Model::read(path).map_err(|error| match error {
        // The missing path may be a mistyped name of a built-in model.
        ModelError::File { path: of, problem } if Path::new(&of) == path && !path.exists() => {
            let names = listed(Model::built_in_names());
            let problem = format!("{problem}: expected a file, or one of {names}");
            file_error("model file", path, problem)
        }
        ModelError::File { path: of, problem } if Path::new(&of) == path => {
            file_error("model file", path, problem)
        }
        other => file_error("model file", path, other),
    })
}

fn file_error(what: &'static str, path: &Path, problem: impl Display) -> ConfigError {
    ConfigError::File {
        what,
        path: path.display().to_string(),
        problem: problem.to_string(),
    }
}

fn in_range(setting: &'static str, got: i128, least: i128, most: i128) -> Result<(), ConfigError> {
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

    #[test]
    fn the_documented_file_contains_the_defaults() {
        let text = include_str!("../../../config/server.toml");
        let read: ServerConfig = toml::from_str(text).expect("settings");
        assert_eq!(read, ServerConfig::default());
        let listed: toml::Table = text.parse().expect("TOML");
        assert_eq!(listed.len(), read.values().len(), "a setting is not listed");
    }
}
