//! Tasks: named sets of worlds with completely fixed settings, on which results can be compared.

use crate::built_in::{TASKS, listed, state_names};
use crate::grid::Cell;
use crate::parameters::Model;
use crate::text::{parse_problem, read_text, shortened};
use serde::{Deserialize, Serialize};
use std::ops::Range;
use std::path::Path;
use thiserror::Error;

/// Maximum number of test seeds.
pub const MAX_SEEDS: u64 = 100_000;

/// The first seed of worlds for training. Lower seeds are for tests, and nothing may be trained or tuned on them.
pub const FIRST_TRAINING_SEED: u64 = 1000;

/// The server settings that define a task's worlds, by their names in `config/server.toml`, and the seeds to test on.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Task {
    /// The built-in name or the file path from which the task was loaded.
    #[serde(skip)]
    pub source: String,
    /// Name of the task.
    pub name: String,
    /// A built-in model or a model file. Empty if the states were recorded.
    #[serde(default)]
    pub model: String,
    /// Built-in recorded states, or a file of recorded states. Empty if a model simulates the worlds.
    #[serde(default)]
    pub states: String,
    /// Whether the seed also selects a symmetry of the grid (a rotation or reflection).
    #[serde(default)]
    pub states_symmetries: bool,
    /// The maximum recorded step at which an episode begins; the seed draws one from 0 to this.
    #[serde(default)]
    pub states_offset: u64,
    /// Grid height in cells; 0 if the recorded states determine it.
    #[serde(default)]
    pub height: usize,
    /// Grid width in cells; 0 if the recorded states determine it.
    #[serde(default)]
    pub width: usize,
    /// Number of rows and columns that robots see beyond each cell of their path; -1 for the radius of the model's
    /// sensor.
    #[serde(default = "as_model_says")]
    pub sensor_radius: i64,
    /// Number of moves in a path.
    pub moves: usize,
    /// Number of robots in each world.
    #[serde(default = "one")]
    pub robots: u32,
    /// Number of steps simulated before k = 0.
    #[serde(default)]
    pub burn_in: u64,
    /// The robots' first cells.
    #[serde(default)]
    pub start: Start,
    /// Number of steps in an episode.
    pub max_steps: u64,
    /// Seeds of the worlds to test on.
    pub test_seeds: Range<u64>,
    /// The task's entry in lists of the built-in tasks.
    #[serde(default)]
    pub listing: Option<Listing>,
}

/// A built-in task's entry in lists of tasks.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Listing {
    /// Position in lists; smaller numbers come first.
    pub place: u32,
    /// Prefix of the ids of the task's Python environments.
    pub ids: String,
    /// Version of the task's worlds. It rises when their settings change, and ends the ids.
    #[serde(default)]
    pub version: u32,
}

/// The robots' cells after a reset.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Start {
    /// The corners, in the order (0, 0), opposite, upper right, lower left. Further robots start at the middles of the
    /// sides, then at the corners again.
    #[default]
    Corner,
    /// All robots in the middle.
    Centre,
    /// Cells drawn from the world's seed.
    Random,
    /// All robots in this cell.
    #[serde(untagged)]
    At(Cell),
}

/// The error for a task that cannot be loaded.
#[derive(Debug, Error)]
#[error("task {}: {problem}", shortened(task))]
pub struct TaskError {
    task: String,
    problem: String,
}

impl Task {
    /// Returns the radius of the sensor, or `None` for the radius of the model's sensor.
    pub fn radius(&self) -> Option<usize> {
        self.sensor_radius.try_into().ok()
    }

    /// Loads the built-in task with this name, or the task file at this path.
    ///
    /// # Errors
    /// If there is no such task or file, or the file is not a valid task.
    pub fn named(name: &str) -> Result<Self, TaskError> {
        let read = match TASKS.iter().find(|(known, _)| *known == name) {
            Some((_, text)) => Self::from_toml(text),
            None if name.is_empty() => Err("expected a name or a file, got \"\"".into()),
            None => Self::read(Path::new(name)),
        };
        let named = |task| Self {
            source: name.into(),
            ..task
        };
        read.map(named).map_err(|problem| TaskError {
            task: name.into(),
            problem,
        })
    }

    /// Lists the names of the built-in tasks.
    pub fn built_in_names() -> impl Iterator<Item = &'static str> {
        Self::built_in_files().map(|(name, _)| name)
    }

    /// Lists the built-in tasks in the order of [`Listing::place`], each as its name and the text of its file.
    pub fn built_in_files() -> impl Iterator<Item = (&'static str, &'static str)> {
        let mut files = TASKS.to_vec();
        files.sort_by_cached_key(|(_, text)| {
            let task = Self::from_toml(text);
            let task = task.expect("invariant: built-in tasks are valid, as a test shows");
            task.listing.map(|listing| listing.place)
        });
        files.into_iter()
    }

    /// Returns whether the hidden states were recorded.
    pub fn is_recorded(&self) -> bool {
        !self.states.is_empty()
    }

    fn read(path: &Path) -> Result<Self, String> {
        check_kind(path)?;
        let text = read_text(path).map_err(|error| {
            if path.exists() {
                return error.to_string();
            }
            let names = listed(Self::built_in_names());
            format!("{error}: expected a file, or one of {names}")
        })?;
        let unlisted = |text| {
            Self::from_toml(text).map(|task| Self {
                listing: None,
                ..task
            })
        };
        let mut task = unlisted(&text)?;
        let same_name = TASKS.iter().find(|(name, _)| *name == task.name);
        if same_name.is_some_and(|(_, text)| unlisted(text).as_ref() != Ok(&task)) {
            return Err(format!(
                "name: expected a name that no built-in task has, got {}",
                task.name
            ));
        }
        let folder = path.parent().unwrap_or(Path::new(""));
        let is_model = Model::built_in(&task.model).is_some();
        let is_states = state_names().any(|name| name == task.states);
        for (setting, file, is_built_in) in [
            ("model", &mut task.model, is_model),
            ("states", &mut task.states, is_states),
        ] {
            let next_to_task = folder.join(&*file);
            if file.is_empty() || !next_to_task.exists() || (is_built_in && next_to_task.is_dir()) {
                continue;
            }
            if is_built_in {
                return Err(format!(
                    "{setting}: {file} is a built-in name and also a file next to the task: write ./{file}, or rename the file"
                ));
            }
            check_kind(&next_to_task).map_err(|problem| format!("{setting}: {problem}"))?;
            *file = next_to_task.display().to_string();
        }
        Ok(task)
    }

    fn from_toml(text: &str) -> Result<Self, String> {
        let task: Self = toml::from_str(text).map_err(parse_problem)?;
        task.check()?;
        Ok(task)
    }

    /// Checks the settings that the server cannot check, because it replaces missing settings with defaults.
    fn check(&self) -> Result<(), String> {
        let needs = |setting: &str, expected: &str, got: &dyn std::fmt::Display| {
            Err(format!("{setting}: expected {expected}, got {got}"))
        };
        if !is_file_name(&self.name) {
            return needs(
                "name",
                "1 to 64 letters, digits, '-', '_' and '.', not starting with '.'",
                &format!("{:?}", shortened(&self.name)),
            );
        }
        if self.model.is_empty() != self.is_recorded() {
            let got = format!("{:?} and {:?}", self.model, self.states);
            return needs("model and states", "exactly one of them", &got);
        }
        let simulated = [
            ("height", self.height as u64),
            ("width", self.width as u64),
            ("burn_in", self.burn_in),
        ];
        for (setting, got) in simulated.into_iter().filter(|_| self.is_recorded()) {
            if got != 0 {
                return needs(setting, "0, because the states determine it", &got);
            }
        }
        if self.max_steps == 0 {
            return needs("max_steps", "at least 1", &0);
        }
        let n_seeds = self.test_seeds.end.saturating_sub(self.test_seeds.start);
        if !(1..=MAX_SEEDS).contains(&n_seeds) {
            return needs("test_seeds", &format!("1 to {MAX_SEEDS}"), &n_seeds);
        }
        Ok(())
    }
}

/// Rejects pipes and devices: reading one may block, and it cannot be read twice.
fn check_kind(path: &Path) -> Result<(), String> {
    match path.metadata() {
        Ok(found) if !found.is_file() && !found.is_dir() => Err(format!(
            "expected a regular file, got a pipe or device at {}",
            path.display()
        )),
        _ => Ok(()),
    }
}

/// Returns whether a name is safe as a file name: 1 to 64 letters, digits, `-`, `_` and `.`, not starting with a dot.
pub fn is_file_name(name: &str) -> bool {
    let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte);
    (1..=64).contains(&name.len()) && name.bytes().all(is_plain) && !name.starts_with('.')
}

fn as_model_says() -> i64 {
    -1
}

fn one() -> u32 {
    1
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn built_in_tasks_differ_in_name_worlds_place_and_ids() {
        assert_eq!(Task::built_in_names().next(), Some("wildfire"));
        let (mut places, mut ids) = (Vec::new(), BTreeSet::new());
        for name in Task::built_in_names() {
            let task = Task::named(name).expect(name);
            assert_eq!((&*task.name, &*task.source), (name, name));
            let model = Model::built_in(&task.model);
            assert_eq!(model.is_none(), task.is_recorded(), "{name}");
            let is_states = state_names().any(|states| states == task.states);
            assert_eq!(is_states, task.is_recorded(), "{name}");
            let listing = task.listing.expect(name);
            places.push(listing.place);
            assert!(ids.insert(listing.ids), "{name}");
        }
        assert!(places.is_sorted_by(|a, b| a < b), "{places:?}");
    }

    /// Each row: a built-in task => a part of its file => the replacement => a part of the resulting error.
    const WRONG: &str = r#"
small => height => heigth => unknown field `heigth`
small => moves = 16 =>  => missing field `moves`
small => model => states = "a.npz", model => model and states: expected exactly one
jacksboro => moves = 64 => moves = 64, height = 3 => height: expected 0, because
jacksboro => moves = 64 => moves = 64, burn_in = 3 => burn_in: expected 0, because
small => max_steps = 300 => max_steps = 0 => max_steps: expected at least 1, got 0
small => name = "small" => name = "" => name: expected 1 to 64
small => name = "small" => name = "../small" => name: expected 1 to 64
small => name = "small" => name = "a b" => name: expected 1 to 64
small => name = "small" => name = ".a" => name: expected 1 to 64
small => name = "small" => name = "/a" => name: expected 1 to 64
small => end = 32 => end = 0 => test_seeds: expected 1 to 100000, got 0
"#;

    #[test]
    fn an_error_names_the_wrong_setting_of_a_task() {
        for line in WRONG.trim().lines() {
            let mut parts = line.split(" => ");
            let [name, from, to, words] = [(); 4].map(|()| parts.next().expect(line));
            let task = TASKS.iter().find(|(known, _)| *known == name);
            let (_, text) = task.expect(line);
            assert!(text.contains(from), "{line}");
            let changed = text.replacen(from, &to.replace(", ", "\n"), 1);
            let error = Task::from_toml(&changed).expect_err(line);
            assert!(error.contains(words), "{line}: {error}");
        }
        let error = Task::named("no/such").expect_err("no task").to_string();
        assert!(error.contains("task no/such: No such file"), "{error}");
        assert!(
            error.contains("expected a file, or one of wildfire, small"),
            "{error}"
        );
    }
}
