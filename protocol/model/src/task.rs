//! Tasks: named sets of worlds with completely fixed settings, on which results can be compared.

use crate::built_in::{TASKS, listed, state_names};
use crate::parameters::Model;
use crate::settings::{SettingError, Settings, WorldSettings};
use crate::text::{parse_problem, read_text, shortened};
use serde::Deserialize;
use serde_json::{Map, Value};
use std::ops::Range;
use std::path::Path;
use thiserror::Error;

pub const MAX_SEEDS: u64 = 100_000;

/// The first seed of worlds for training. Lower seeds are for tests, and nothing may be trained or tuned on them.
pub const FIRST_TRAINING_SEED: u64 = 1000;

#[derive(Debug, Clone, PartialEq)]
pub struct Task {
    /// The built-in name or the file path from which the task was loaded.
    pub source: String,
    pub name: String,
    /// All settings of the worlds. Settings that recorded states decide are empty or 0.
    pub world: WorldSettings,
    pub test_seeds: Range<u64>,
    pub listing: Option<Listing>,
}

#[derive(Deserialize)]
struct TaskFile {
    name: String,
    test_seeds: Range<u64>,
    listing: Option<Listing>,
    #[serde(flatten)]
    given: Map<String, Value>,
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

#[derive(Debug, Error)]
#[error("task {}: {problem}", shortened(task))]
pub struct TaskError {
    task: String,
    problem: String,
}

impl Task {
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
        let world = &mut task.world;
        let is_model = Model::built_in(&world.model).is_some();
        let is_states = state_names().any(|name| name == world.states);
        for (setting, file, is_built_in) in [
            ("model", &mut world.model, is_model),
            ("states", &mut world.states, is_states),
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
        let file: TaskFile = toml::from_str(text).map_err(parse_problem)?;
        let world = WorldSettings::default().without_states();
        let world = world.replaced(&file.given).map_err(|it| it.to_string())?;
        check(&file, &world).map_err(|it| it.to_string())?;
        Ok(Self {
            source: String::new(),
            name: file.name,
            world,
            test_seeds: file.test_seeds,
            listing: file.listing,
        })
    }
}

/// Checks what a task file must give and leave out, besides the range of each setting.
fn check(file: &TaskFile, world: &WorldSettings) -> Result<(), SettingError> {
    let wrong =
        |setting: &str, expected: &str, got: Value| Err(SettingError::new(setting, expected, got));
    if !is_file_name(&file.name) {
        let expected = "1 to 64 letters, digits, '-', '_' and '.', not starting with '.'";
        return wrong("name", expected, format!("{:?}", file.name).into());
    }
    if world.model.is_empty() != world.is_recorded() {
        let got = format!("{:?} and {:?}", world.model, world.states);
        return wrong("model and states", "exactly one of them", got.into());
    }
    let of_states = WorldSettings::settings().into_iter();
    let mut of_states = of_states.filter(|it| it.of_states && world.is_recorded());
    if let Some((name, got)) = of_states.find_map(|it| file.given.get_key_value(it.name)) {
        return wrong(name, "to be left out, as the states decide it", got.clone());
    }
    if !file.given.contains_key("moves") {
        return wrong("moves", "the number of moves in a path", "none".into());
    }
    if world.max_steps == 0 {
        return wrong("max_steps", "at least 1", 0.into());
    }
    let n_seeds = file.test_seeds.end.saturating_sub(file.test_seeds.start);
    if !(1..=MAX_SEEDS).contains(&n_seeds) {
        return wrong("test_seeds", &format!("1 to {MAX_SEEDS}"), n_seeds.into());
    }
    Ok(())
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
            let (world, is_recorded) = (&task.world, task.world.is_recorded());
            assert_eq!(
                Model::built_in(&world.model).is_none(),
                is_recorded,
                "{name}"
            );
            let is_states = state_names().any(|states| states == world.states);
            assert_eq!(is_states, is_recorded, "{name}");
            let listing = task.listing.expect(name);
            places.push(listing.place);
            assert!(ids.insert(listing.ids), "{name}");
        }
        assert!(places.is_sorted_by(|a, b| a < b), "{places:?}");
    }

    /// Each row: a built-in task => a part of its file => the replacement => a part of the resulting error.
    const WRONG: &str = r#"
small => height => heigth => heigth: expected the name of a setting (burn_in, height,
small => moves = 16 =>  => moves: expected the number of moves in a path, got none
small => model => states = "a.npz", model => model and states: expected exactly one
jacksboro => moves = 64 => moves = 64, height = 3 => height: expected to be left out, as the states
jacksboro => moves = 64 => moves = 64, burn_in = 3 => burn_in: expected to be left out, as the states
small => max_steps = 300 => max_steps = 0 => max_steps: expected at least 1, got 0
small => name = "small" => name = "" => name: expected 1 to 64
small => name = "small" => name = "../small" => name: expected 1 to 64
small => name = "small" => name = ".a" => name: expected 1 to 64
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
