//! Settings given by name, from flags or from a program. Each one replaces the value in the settings file, or the
//! default.

use crate::bounds::BOUNDS;
use crate::config::{ConfigError, ServerConfig};
use emberwatch_messages::control::CoverageRule;
use emberwatch_model::Cell;
use emberwatch_model::task::{Start, Task};
use serde::Deserialize;
use serde_json::{Map, Value, json};

/// Settings that a states file determines.
const OF_STATES: [&str; 4] = ["model", "height", "width", "burn_in"];

/// Settings that a task determines.
const OF_TASK: [&str; 12] = [
    "model",
    "sensor_radius",
    "states",
    "states_symmetries",
    "states_offset",
    "height",
    "width",
    "moves",
    "robots",
    "burn_in",
    "max_steps",
    "start",
];

impl ServerConfig {
    /// Returns a copy of these settings with the values in `given`. Its keys are the names in `config/server.toml`. The
    /// value of `start` may also be a string such as `3,5`.
    ///
    /// # Errors
    /// If a name is unknown, a value is invalid, or a task or recorded states determine the setting.
    pub fn with(&self, given: &Map<String, Value>) -> Result<Self, ConfigError> {
        let mut settings = self.values();
        for (name, value) in given {
            let checked = check(name, value, settings.get(name));
            let checked = checked.map_err(|expected| refused(name, expected, value))?;
            settings.insert(name.clone(), checked);
        }
        let config = Self::deserialize(Value::Object(settings));
        let config = config.expect("invariant: each value was checked");
        if given.get("task").and_then(Value::as_str) == Some("") {
            Task::named("")?;
        }
        if !config.task.is_empty() {
            check_left_out(given, &OF_TASK, "the task decides it")?;
        } else if !config.states.is_empty() {
            check_left_out(given, &OF_STATES, "the states file decides it")?;
        }
        Ok(config)
    }
}

/// Returns a setting's value if it has the type of the default and is within bounds. Otherwise returns what was
/// expected, for the error.
fn check(name: &str, value: &Value, default: Option<&Value>) -> Result<Value, String> {
    let fits = match (name, default) {
        (_, None) => {
            let known = ServerConfig::default().values();
            let known: Vec<&str> = known.keys().map(String::as_str).collect();
            return Err(format!("the name of a setting ({})", known.join(", ")));
        }
        ("start", _) => {
            let start = match value {
                Value::String(text) => start_of(text).ok(),
                other => Start::deserialize(other).ok(),
            };
            let start = start.ok_or("corner, centre, random or ROW,COL")?;
            return Ok(json!(start));
        }
        ("coverage", _) => {
            let is_rule = CoverageRule::deserialize(value).is_ok();
            is_rule.then_some(()).ok_or("path, full or client")
        }
        (_, Some(Value::Bool(_))) => value.as_bool().map(drop).ok_or("true or false"),
        (_, Some(Value::String(_))) => value.as_str().map(drop).ok_or("text"),
        _ => return within(name, value),
    };
    fits?;
    Ok(value.clone())
}

fn within(name: &str, value: &Value) -> Result<Value, String> {
    let bounds = BOUNDS.iter().find(|(setting, ..)| *setting == name);
    let (_, least, most) = bounds.expect("invariant: each numeric setting has bounds");
    let number = value.as_number().and_then(serde_json::Number::as_i128);
    match number.filter(|number| (least..=most).contains(&number)) {
        Some(_) => Ok(value.clone()),
        None => Err(format!("{least} to {most}")),
    }
}

fn check_left_out(
    given: &Map<String, Value>,
    decided: &[&str],
    why: &str,
) -> Result<(), ConfigError> {
    let wrong = decided.iter().find_map(|name| given.get_key_value(*name));
    wrong.map_or(Ok(()), |(name, value)| {
        Err(refused(name, format!("to be left out, as {why}"), value))
    })
}

fn refused(name: &str, expected: String, got: &Value) -> ConfigError {
    ConfigError::Given {
        setting: name.into(),
        expected,
        got: match got {
            Value::String(text) => text.clone(),
            other => other.to_string(),
        },
    }
}

/// Parses the start of robots: `corner`, `centre`, `random` or `ROW,COL`.
pub fn start_of(text: &str) -> Result<Start, String> {
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

#[cfg(test)]
mod tests {
    use super::*;

    fn with(given: Value) -> Result<ServerConfig, String> {
        let given = given.as_object().expect("a dictionary").clone();
        let config = ServerConfig::default().with(&given);
        config.map_err(|error| error.to_string())
    }

    #[test]
    fn each_numeric_setting_has_bounds_that_include_its_default() {
        let defaults = ServerConfig::default().values();
        let numbers = defaults.iter().filter(|(_, value)| value.is_number());
        assert_eq!(numbers.clone().count(), BOUNDS.len());
        for (name, value) in numbers {
            assert_eq!(within(name, value).as_ref(), Ok(value));
        }
    }

    #[test]
    fn settings_are_replaced_by_name() {
        let seed = u64::MAX;
        let given = json!({"seed": seed, "height": 7, "start": "3, 5", "coverage": "full",
            "model": "wildfire-small", "publish_truth": true, "sensor_radius": 8});
        let config = with(given).expect("valid");
        assert_eq!((config.seed, config.height, config.width), (seed, 7, 64));
        assert_eq!(config.start, Start::At(Cell { row: 3, col: 5 }));
        assert_eq!(config.coverage, CoverageRule::Full);
        assert!(config.publish_truth && config.sensor_radius == 8);
        let start = json!({"start": {"row": 3, "col": 5}});
        assert_eq!(with(start).map(|it| it.start), Ok(config.start));
    }

    /// Invalid settings, and a part of the error for each.
    const WRONG: &str = r#"
{"height": -1} => height: expected 1 to 4096, got -1
{"height": 16.0} => height: expected 1 to 4096, got 16.0
{"height": "x"} => height: expected 1 to 4096, got x
{"width": 4097} => width: expected 1 to 4096, got 4097
{"moves": null} => moves: expected 1 to 4096, got null
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
