//! Settings: each is one declaration with its type, default, range and help, from which files, flags, programs and the
//! Python package are read and checked. [`WorldSettings`] define worlds; a server adds settings of its own.

use crate::built_in::{listed, state_names};
use crate::file::MAX_RADIUS;
use crate::grid::{Cell, MAX_SIDE};
use crate::parameters::Model;
use crate::path::MAX_MOVES;
use crate::text::shortened;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use std::str::FromStr;
use thiserror::Error;

pub const MAX_ROBOTS: usize = 64;

/// The range of settings that accept any unsigned 64-bit number.
pub const ANY: (i128, i128) = (0, u64::MAX as i128);

#[derive(Debug, Clone, Copy)]
pub struct Setting {
    /// Name in files, programs and messages. The flag has hyphens instead of underscores.
    pub name: &'static str,
    /// One sentence without a full stop.
    pub help: &'static str,
    pub default: fn() -> Value,
    pub fits: fn(&Value) -> bool,
    /// Minimum and maximum of a number.
    pub range: Option<(i128, i128)>,
    /// The values to choose from, for errors; empty for the values of the type.
    pub expected: &'static str,
    /// The placeholder of the value in a program's help; empty for the setting's name.
    pub placeholder: &'static str,
    pub names: Option<fn() -> String>,
    /// Whether recorded states decide the setting.
    pub of_states: bool,
    /// Whether the setting has its default unless states are recorded.
    pub for_states: bool,
    /// Whether the setting applies only to servers, not to worlds inside another process.
    pub for_servers: bool,
}

/// A struct of settings, which [`settings!`](crate::settings!) declares.
pub trait Settings: Default + Serialize + DeserializeOwned {
    fn settings() -> Vec<Setting>;

    fn values(&self) -> Map<String, Value> {
        match serde_json::to_value(self) {
            Ok(Value::Object(values)) => values,
            _ => unreachable!("invariant: settings serialise"),
        }
    }

    /// Returns a copy of these settings with the values in `given`.
    fn replaced(&self, given: &Map<String, Value>) -> Result<Self, SettingError> {
        let (known, mut values) = (Self::settings(), self.values());
        for (name, value) in given {
            let setting = known.iter().find(|setting| setting.name == name);
            let setting = setting.ok_or_else(|| {
                let mut names: Vec<&str> = known.iter().map(|setting| setting.name).collect();
                names.sort_unstable();
                let names = names.join(", ");
                SettingError::new(
                    name,
                    format!("the name of a setting ({names})"),
                    value.clone(),
                )
            })?;
            setting.check(value)?;
            values.insert(name.clone(), value.clone());
        }
        let settings = Self::deserialize(Value::Object(values));
        Ok(settings.expect("invariant: each value was checked"))
    }
}

#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("{}: expected {expected}, got {}", shortened(setting), shortened(got))]
pub struct SettingError {
    setting: String,
    expected: String,
    got: String,
}

impl SettingError {
    pub fn new(setting: &str, expected: impl Into<String>, got: impl Into<Value>) -> Self {
        Self {
            setting: setting.into(),
            expected: expected.into(),
            got: match got.into() {
                Value::String(text) => text,
                other => other.to_string(),
            },
        }
    }
}

impl Setting {
    /// The parts that most declarations leave out.
    pub const PLAIN: Self = Self {
        name: "",
        help: "",
        default: || Value::Null,
        fits: Value::is_null,
        range: None,
        expected: "",
        placeholder: "",
        names: None,
        of_states: false,
        for_states: false,
        for_servers: false,
    };

    /// Checks the type and range of a value.
    ///
    /// # Errors
    /// If the type is wrong, or a number is out of range.
    pub fn check(&self, value: &Value) -> Result<(), SettingError> {
        let number = || value.as_number()?.as_i128();
        let in_range = match self.range {
            Some((least, most)) => number().is_some_and(|it| (least..=most).contains(&it)),
            None => true,
        };
        if in_range && (self.fits)(value) {
            return Ok(());
        }
        Err(SettingError::new(self.name, self.expected(), value.clone()))
    }

    /// Parses the value of a flag, and checks it.
    ///
    /// # Errors
    /// Says what was expected.
    pub fn parse(&self, text: &str) -> Result<Value, String> {
        let values = [Some(text.into()), serde_json::from_str(text).ok()];
        let mut values = values.into_iter().flatten();
        let valid = values.find(|value| self.check(value).is_ok());
        valid.ok_or_else(|| format!("expected {}", self.expected()))
    }

    pub fn is_switch(&self) -> bool {
        (self.default)().is_boolean()
    }

    /// Returns the help with built-in names, range and default, for a program's flags.
    pub fn explanation(&self) -> String {
        let mut text = self.help.to_owned();
        if let Some(names) = self.names {
            text += &format!(": {}, or a path", names());
        }
        let range = self.range.filter(|range| *range != ANY);
        let range = range.map(|(least, most)| format!("{least} to {most}"));
        let default = (self.default)().to_string();
        let default = default.trim_matches('"');
        let default = (!default.is_empty()).then(|| format!("default: {default}"));
        let facts: Vec<String> = range.into_iter().chain(default).collect();
        if !facts.is_empty() {
            text += &format!(" [{}]", facts.join("; "));
        }
        text
    }

    fn expected(&self) -> String {
        match (self.range, self.expected) {
            (Some((least, most)), _) => format!("{least} to {most}"),
            (None, "") if self.is_switch() => "true or false".into(),
            (None, "") => "text".into(),
            (None, words) => words.into(),
        }
    }
}

pub fn is<T: DeserializeOwned>(value: &Value) -> bool {
    T::deserialize(value).is_ok()
}

/// Declares a struct of settings: `name: Type = default => { ... }`, where the braces contain the parts of a
/// [`Setting`] that differ from [`Setting::PLAIN`], and the comment is its help. `..name: Type` at the beginning
/// includes all settings of another struct.
#[macro_export]
macro_rules! settings {
    ($(#[$meta:meta])* pub struct $struct:ident {
        $(..$part:ident: $Part:ty;)?
        $($(#[doc = $help:literal])+ $name:ident: $type:ty = $default:expr => {
            $($key:ident: $value:expr),* $(,)?
        };)*
    }) => {
        $(#[$meta])*
        #[derive(Debug, Clone, PartialEq, ::serde::Serialize, ::serde::Deserialize)]
        pub struct $struct {
            $(#[allow(missing_docs)] #[serde(flatten)] pub $part: $Part,)?
            $($(#[doc = $help])+ pub $name: $type,)*
        }

        impl Default for $struct {
            fn default() -> Self {
                Self {
                    $($part: <$Part>::default(),)?
                    $($name: $default,)*
                }
            }
        }

        impl $crate::settings::Settings for $struct {
            fn settings() -> Vec<$crate::settings::Setting> {
                #[allow(unused_mut)]
                let mut all = vec![$($crate::settings::Setting {
                    name: stringify!($name),
                    help: concat!($($help),+).trim_ascii(),
                    default: || {
                        let default: $type = $default;
                        ::serde_json::json!(default)
                    },
                    fits: $crate::settings::is::<$type>,
                    $($key: $value,)*
                    ..$crate::settings::Setting::PLAIN
                }),*];
                $(all.extend(<$Part as $crate::settings::Settings>::settings());)?
                all
            }
        }
    };
}

settings! {
    /// The settings that define a server's worlds. A task decides all of them.
    #[derive(Eq)]
    pub struct WorldSettings {
        /// Model of the worlds
        model: String = "wildfire".into() => {
            placeholder: "NAME|FILE",
            names: Some(|| listed(Model::built_in_names())),
            of_states: true,
        };
        /// Number of rows and columns that robots see beyond each cell of their path; -1: the model's
        sensor_radius: i64 = -1 => { range: Some((-1, MAX_RADIUS as i128)) };
        /// Grid height in cells
        height: usize = 64 => { range: Some((1, MAX_SIDE as i128)), of_states: true };
        /// Grid width in cells
        width: usize = 64 => { range: Some((1, MAX_SIDE as i128)), of_states: true };
        /// Number of moves in a path
        moves: usize = 64 => { range: Some((1, MAX_MOVES as i128)) };
        /// Number of robots in each world
        robots: u32 = 1 => { range: Some((1, MAX_ROBOTS as i128)) };
        /// Number of steps simulated before k = 0
        burn_in: u64 = 10_000 => { range: Some((0, 1 << 40)), of_states: true };
        /// Maximum episode length in steps; 0: no limit
        max_steps: u64 = 0 => { range: Some(ANY) };
        /// Start cells of robots: corner (a different one for each), centre, random or ROW,COL
        start: Start = Start::Corner => { expected: "corner, centre, random or ROW,COL" };
        /// Show recorded states, which decide model, grid and burn-in
        states: String = String::new() => {
            placeholder: "NAME|FILE|FOLDER",
            names: Some(|| listed(state_names())),
            for_states: true,
        };
        /// Let seeds also select a symmetry of the recorded grid
        states_symmetries: bool = false => { for_states: true };
        /// Maximum recorded step at which an episode begins; the seed draws one from 0 to this
        states_offset: u64 = 0 => {
            placeholder: "STEPS",
            range: Some(ANY),
            for_states: true,
        };
    }
}

impl WorldSettings {
    pub fn is_recorded(&self) -> bool {
        !self.states.is_empty()
    }

    /// Returns the radius of the sensor, or `None` for the radius of the model's sensor.
    pub fn radius(&self) -> Option<usize> {
        self.sensor_radius.try_into().ok()
    }

    /// Returns the same settings, but empty or 0 where recorded states decide.
    pub fn without_states(&self) -> Self {
        let mut values = self.values();
        for setting in Self::settings().iter().filter(|it| it.of_states) {
            let is_text = (setting.default)().is_string();
            values.insert(
                setting.name.into(),
                if is_text { "".into() } else { 0.into() },
            );
        }
        Self::deserialize(Value::Object(values)).expect("invariant: texts and numbers")
    }
}

/// The robots' cells after a reset.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Start {
    /// The corners, in the order (0, 0), opposite, upper right, lower left. Further robots start at the middles of the
    /// sides, then at the corners again.
    #[default]
    Corner,
    Centre,
    /// Cells drawn from the world's seed.
    Random,
    #[serde(untagged)]
    At(#[serde(deserialize_with = "start_cell")] Cell),
}

#[derive(Deserialize)]
#[serde(untagged)]
enum StartCell {
    Cell(Cell),
    Text(String),
}

fn start_cell<'de, D: serde::Deserializer<'de>>(reader: D) -> Result<Cell, D::Error> {
    let cell = match StartCell::deserialize(reader)? {
        StartCell::Cell(cell) => Some(cell),
        StartCell::Text(text) => text.split_once(',').and_then(|(row, col)| {
            let [row, col] = [row, col].map(|part| usize::from_str(part.trim()).ok());
            Some(Cell {
                row: row?,
                col: col?,
            })
        }),
    };
    cell.ok_or_else(|| serde::de::Error::custom("expected ROW,COL"))
}
