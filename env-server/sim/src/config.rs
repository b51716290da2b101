//! The server's settings and their checks.

use crate::states_file::{StatesError, StatesFile};
use crate::world::{Reach, Recorded};
use emberwatch_messages::capacity::{MAX_ROBOT_NUMBERS, MAX_TEAM_CELLS, MAX_WORLDS};
use emberwatch_messages::control::CoverageRule;
use emberwatch_messages::errors::ChannelError;
use emberwatch_messages::instance::Instance;
use emberwatch_model::ModelError;
use emberwatch_model::built_in::listed;
use emberwatch_model::grid::ShapeError;
use emberwatch_model::settings;
use emberwatch_model::settings::{ANY, SettingError, Settings, Start, WorldSettings};
use emberwatch_model::task::{Task, TaskError};
use emberwatch_model::text::{parse_problem, read_text, shortened};
use emberwatch_model::{Hazards, Model, Ratio, Shape, TRANSITIONS_FORM};
use serde_json::{Map, Value};
use std::fmt::Display;
use std::path::Path;
use std::sync::Arc;
use thiserror::Error;

const DAY: i128 = 86_400_000;

settings! {
    /// All settings of a server; `config/server.toml` explains each further.
    pub struct ServerConfig {
        ..world: WorldSettings;
        /// Name under which clients find this server
        instance: String = "default".into() => { for_servers: true };
        /// Use the worlds of a task, which decides all settings of worlds
        task: String = String::new() => {
            placeholder: "NAME|FILE",
            names: Some(|| listed(Task::built_in_names())),
        };
        /// Number of independent worlds
        worlds: u32 = 1 => { range: Some((1, MAX_WORLDS as i128)) };
        /// Seed of world 0; world i starts from this seed plus i
        seed: u64 = 0 => { range: Some(ANY) };
        /// Maximum wait of a world for its robots' paths, in milliseconds after the first path; 0: no limit
        deadline_millis: u64 = 0 => { range: Some((0, DAY)), for_servers: true };
        /// Cells that a robot observes in a step: path (the cells on it), full (every cell), or client (path, unless a
        /// request asks for every cell)
        coverage: CoverageRule = CoverageRule::Path => { expected: "path, full or client" };
        /// Publish the hidden states, for evaluation and display
        publish_truth: bool = false => {};
        /// Send clients the model
        reveal_model: bool = true => {};
        /// Time from the last use of a lease until it ends, in milliseconds
        lease_millis: u64 = 30_000 => { range: Some((100, DAY)) };
        /// Number of threads that simulate; 0: one per core
        threads: usize = 0 => { range: Some((0, 256)) };
        /// Number of the latest steps of each world whose frames are kept for agents that take over
        history: u32 = 256 => { range: Some((1, 1_000_000)) };
        /// Start with the worlds of this snapshot file, or of the latest one in this folder, if there is one
        restore: String = String::new() => { placeholder: "FILE|FOLDER", for_servers: true };
        /// Number of steps, on average over the worlds, between two snapshots; another is written at the end; 0: never
        snapshot_every: u64 = 0 => { range: Some(ANY), placeholder: "STEPS", for_servers: true };
        /// Folder for these snapshots
        snapshot_dir: String = String::new() => { placeholder: "FOLDER", for_servers: true };
        /// Number of these snapshots to keep, in addition to the latest one that is safely on disk
        snapshot_keep: u32 = 3 => { range: Some((1, 1_000_000)), for_servers: true };
    }
}

/// Checked settings, together with the model and the recorded states that were loaded for them.
#[derive(Debug, Clone)]
pub struct Checked {
    pub config: ServerConfig,
    pub instance: Instance,
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
    /// A setting with an unknown name or a value outside its range, or one that a task or recorded states decide.
    #[error(transparent)]
    Setting(#[from] SettingError),
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

impl Checked {
    pub fn with_worlds(mut self, worlds: u32) -> Result<Self, ConfigError> {
        self.config.worlds = worlds;
        self.config.check_ranges()?;
        self.config.check_robots(self.shape)?;
        Ok(self)
    }

    pub fn about_model(&self) -> String {
        let (model, file) = (&self.model, self.model.file());
        let rule = if file.transitions.is_empty() {
            format!("{} kernel entries", file.kernel.len())
        } else {
            format!("{} transitions", file.transitions.len())
        };
        let maps = model.hazards().and_then(Hazards::shape);
        let maps = maps.map_or_else(String::new, |shape| format!(", maps {shape}"));
        format!(
            "model {:?}: {} states, {rule}{maps}",
            shortened(model.name()),
            model.n_states()
        )
    }

    pub fn warnings(&self) -> Vec<String> {
        let model = &self.model;
        let mut warnings: Vec<String> = self
            .reach
            .closed_in
            .iter()
            .map(ToString::to_string)
            .collect();
        if model.reward().iter().all(|&reward| reward == 0.0) {
            warnings.push(format!(
                "model {:?}: no state pays: every reward will be 0; give a state a `reward` in the model file",
                model.name()
            ));
        }
        if let Some(uneven) = model.ratio().and_then(Ratio::uneven_place) {
            let ([row, col], [least, most]) = (uneven.place, uneven.states);
            let names = model.state_names();
            warnings.push(format!(
                "kernel: expected weights of all states within a factor of 2, got a sum of {} for {:?} and {} for \
                 {:?} in row {row}, column {col}, so filters predict badly: write transitions instead, by which each \
                 neighbour tries independently:\n{TRANSITIONS_FORM}",
                uneven.weights[0], names[least], uneven.weights[1], names[most],
            ));
        }
        warnings
    }
}

impl ServerConfig {
    pub fn with(&self, given: &Map<String, Value>) -> Result<Self, ConfigError> {
        let config = self.replaced(given)?;
        if given.get("task").and_then(Value::as_str) == Some("") {
            Task::named("")?;
        }
        let (has_task, has_states) = (!config.task.is_empty(), config.world.is_recorded());
        let decider = if has_task { "task" } else { "states file" };
        for setting in WorldSettings::settings() {
            let is_decided = has_task || has_states && setting.of_states;
            if let Some(got) = given.get(setting.name).filter(|_| is_decided) {
                let expected = format!("to be left out, as the {decider} decides it");
                return Err(SettingError::new(setting.name, expected, got.clone()).into());
            }
        }
        Ok(config)
    }

    /// Checks all settings and loads the files named in them.
    ///
    /// A task replaces all settings of worlds. A states file replaces the model, the grid and the burn-in.
    pub fn check(mut self) -> Result<Checked, ConfigError> {
        let instance = Instance::new(&self.instance)?;
        let name = Some(&self.task).filter(|name| !name.is_empty());
        let task = name.map(|name| Task::named(name)).transpose()?;
        if let Some(task) = &task {
            self.world = task.world.clone();
        }
        self.check_ranges()?;
        let (model, recorded) = if self.world.is_recorded() {
            self.read_states()
                .map(|(model, it)| (Some(model), Some(it)))?
        } else {
            (None, None)
        };
        let shape = Shape::new(self.world.height, self.world.width)?;
        self.check_robots(shape)?;
        if let Start::At(cell) = self.world.start
            && !shape.contains(cell)
        {
            let expected = format!("a cell on the {shape} grid");
            return Err(SettingError::new("start", expected, cell.to_string()).into());
        }
        let model = model.map_or_else(|| model_named(&self.world.model), Ok)?;
        let model = match self.world.radius() {
            Some(radius) => model.with_radius(radius)?,
            None => model,
        };
        let airspace = model.airspace(shape)?;
        let reach = Reach::of(self.world.start, &airspace, self.world.robots as usize);
        let reach = reach.map_err(|[expected, got]| SettingError::new("start", expected, got))?;
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

    fn check_ranges(&self) -> Result<(), SettingError> {
        let (values, is_recorded) = (self.values(), self.world.is_recorded());
        let settings = Self::settings().into_iter();
        for setting in settings.filter(|it| !(is_recorded && it.of_states)) {
            let (value, default) = (&values[setting.name], (setting.default)());
            setting.check(value)?;
            if setting.for_states && !is_recorded && *value != default {
                let expected = format!("{default} without a states file");
                return Err(SettingError::new(setting.name, expected, value.clone()));
            }
        }
        if (self.snapshot_every == 0) != self.snapshot_dir.is_empty() {
            let got = format!("{} and {:?}", self.snapshot_every, self.snapshot_dir);
            let settings = "snapshot_every and snapshot_dir";
            return Err(SettingError::new(settings, "both or neither", got));
        }
        Ok(())
    }

    fn check_robots(&self, shape: Shape) -> Result<(), SettingError> {
        let (n_robots, n_worlds) = (self.world.robots as usize, self.worlds as usize);
        for (product, got, most) in [
            (
                "worlds times robots",
                n_worlds * n_robots,
                MAX_ROBOT_NUMBERS,
            ),
            (
                "cells times robots",
                shape.n_cells() * n_robots,
                MAX_TEAM_CELLS,
            ),
        ] {
            if !(1..=most).contains(&got) {
                return Err(SettingError::new(product, format!("1 to {most}"), got));
            }
        }
        Ok(())
    }

    pub fn read(path: &Path) -> Result<Self, ConfigError> {
        let wrong = |error: &dyn Display| file_error("config file", path, error);
        let text = read_text(path).map_err(|error| wrong(&error))?;
        let given = toml::from_str(&text).map_err(|error| wrong(&parse_problem(error)))?;
        let config = Self::default().replaced(&given);
        config.map_err(|error| wrong(&error))
    }

    fn read_states(&mut self) -> Result<(Model, CheckedStates), ConfigError> {
        let file = StatesFile::named(&self.world.states)?;
        self.world = self.world.without_states();
        (self.world.height, self.world.width) = file.shape.dim();
        let checksum = file.sequences.checksum();
        let (symmetries, offset) = (self.world.states_symmetries, self.world.states_offset);
        let recorded = Recorded::new(file.sequences.arrays, file.shape, symmetries, offset)
            .map_err(|most| {
                let expected = format!("0 to {most}, as the shortest sequence allows");
                SettingError::new("states_offset", expected, offset)
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

#[cfg(test)]
mod tests {
    use super::*;
    use emberwatch_model::Cell;
    use serde_json::json;

    #[test]
    fn the_documented_file_contains_the_defaults() {
        let text = include_str!("../../../config/server.toml");
        let listed: Map<String, Value> = toml::from_str(text).expect("settings");
        assert_eq!(listed, ServerConfig::default().values());
        let settings = ServerConfig::settings();
        assert_eq!(listed.len(), settings.len());
        for setting in settings {
            assert_eq!(setting.check(&listed[setting.name]), Ok(()));
        }
    }

    #[test]
    fn a_task_has_the_worlds_of_its_settings() {
        let small = json!({"model": "wildfire-small", "height": 16, "width": 16, "moves": 16, "burn_in": 3000,
            "max_steps": 300});
        let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../../config/tasks/small.toml");
        let fingerprint = |given: Value| {
            let checked = with(given).expect("valid").check().expect("valid");
            let settings = crate::snapshot::Settings::of(&checked);
            (
                settings.worlds_fingerprint(),
                checked.config.world.max_steps,
            )
        };
        let expected = fingerprint(small);
        assert_eq!(fingerprint(json!({"task": "small"})), expected);
        assert_eq!(fingerprint(json!({"task": file})), expected);
    }

    fn with(given: Value) -> Result<ServerConfig, String> {
        let given = given.as_object().expect("a dictionary").clone();
        let config = ServerConfig::default().with(&given);
        config.map_err(|error| error.to_string())
    }

    #[test]
    fn settings_are_replaced_by_name() {
        let seed = u64::MAX;
        let given = json!({"seed": seed, "height": 7, "start": "3, 5", "coverage": "full",
            "model": "wildfire-small", "publish_truth": true, "sensor_radius": 8});
        let config = with(given).expect("valid");
        let world = config.world;
        assert_eq!((config.seed, world.height, world.width), (seed, 7, 64));
        assert_eq!(world.start, Start::At(Cell { row: 3, col: 5 }));
        assert_eq!(config.coverage, CoverageRule::Full);
        assert!(config.publish_truth && world.sensor_radius == 8);
        let start = json!({"start": {"row": 3, "col": 5}});
        assert_eq!(with(start).map(|it| it.world.start), Ok(world.start));
    }

    const WRONG: &str = r#"
{"height": -1} => height: expected 1 to 4096, got -1
{"height": 16.0} => height: expected 1 to 4096, got 16.0
{"height": "x"} => height: expected 1 to 4096, got x
{"width": 4097} => width: expected 1 to 4096, got 4097
{"seed": -1} => seed: expected 0 to 18446744073709551615, got -1
{"worlds": 4294967296} => worlds: expected 1 to 1024, got 4294967296
{"reveal_model": 1} => reveal_model: expected true or false, got 1
{"model": 3} => model: expected text, got 3
{"coverage": "some"} => coverage: expected path, full or client, got some
{"start": "north"} => start: expected corner, centre, random or ROW,COL, got north
{"wrolds": 2} => wrolds: expected the name of a setting (burn_in, coverage
{"task": "small", "robots": 1} => robots: expected to be left out, as the task decides it, got 1
{"states": "jacksboro", "height": 1} => height: expected to be left out, as the states file
{"task": ""} => task : expected a name or a file, got ""
"#;

    #[test]
    fn errors_name_the_wrong_setting() {
        for line in WRONG.trim().lines() {
            let (given, words) = line.split_once(" => ").expect(line);
            let error = with(serde_json::from_str(given).expect(line)).expect_err(line);
            assert!(error.contains(words), "{line}: {error}");
        }
    }
}
