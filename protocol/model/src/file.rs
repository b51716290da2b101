//! The format of a model file in TOML, and its errors.

use super::cell_map::CellMap;
use super::grid::{Cell, Shape};
use super::maps::MapsEntry;
use crate::text::{parse_problem, read_text, shortened};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;
use thiserror::Error;

/// Maximum number of states, and of observations: 64.
pub const MAX_VALUES: usize = 64;

/// Maximum side of a kernel: 15 cells.
pub const MAX_KERNEL_SIDE: usize = 15;

/// Minimum sum of a cell's weights, relative to the largest weight. The smallest normal `f32` is 1e-38, so larger sums
/// keep their precision.
pub(super) const LEAST_SHARE: f64 = 1e-30;

/// Minimum probability of a transition that is not 0: 1e-9.
pub const MIN_PROBABILITY: f64 = 1e-9;

/// Maximum radius of a sensor: 8 cells.
pub const MAX_RADIUS: usize = 8;

/// A model as written in TOML; [`super::Model::new`] checks it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelFile {
    pub name: String,
    /// Number of rows and columns of the transition kernel, both odd. Only for models with `kernel`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kernel_size: Option<[usize; 2]>,
    /// Name of the state of all cells outside the grid. Without it, these cells influence no other cell.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub edge: Option<String>,
    /// Maps that transitions name in `times`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub maps: Option<MapsEntry>,
    /// No-fly map: 1 for each cell closed to robots.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub no_fly: Option<CellMap>,
    /// The sensor of a robot. Without it, a robot sees the cells of its path.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sensor: Option<SensorEntry>,
    /// The states, in the order of their values.
    pub states: Vec<StateEntry>,
    /// The observations, in the order of their values.
    pub observations: Vec<ObservationEntry>,
    /// The nonzero blocks `w[to, from]` of the kernel of eq. 2. A model has either these or `transitions`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub kernel: Vec<KernelEntry>,
    /// The transitions of a model of hazards. Those of each state are in order: the first that happens wins.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub transitions: Vec<TransitionEntry>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StateEntry {
    /// Name, unique among the states: letters, digits, `-` and `_`.
    pub name: String,
    /// Colour in pictures, `#rrggbb`.
    pub color: String,
    /// Probability of this state in each cell at the start of burn-in.
    pub initial: f64,
    /// Reward for each distinct visited cell in this state.
    #[serde(default)]
    pub reward: f64,
    /// The bias `b[to]` of eq. 2.
    #[serde(default)]
    pub bias: f64,
    /// `P(y | this state)`, one entry per observation (eq. 1).
    pub observed_as: Vec<f64>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObservationEntry {
    pub name: String,
    /// Colour in pictures, `#rrggbb`.
    pub color: String,
}

/// The sensor of a robot.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SensorEntry {
    /// Number of rows and columns that the sensor sees beyond each cell of the path (a Chebyshev distance).
    #[serde(default)]
    pub radius: usize,
}

/// One block `w[to, from]` of a kernel in a model file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KernelEntry {
    /// Name of the neighbour's state at step k.
    pub from: String,
    /// Name of the cell's state at step k + 1.
    pub to: String,
    /// Factor by which every weight is multiplied.
    #[serde(default = "one")]
    pub scale: f64,
    /// Weights `[row offset][column offset]`. The centre is the cell itself, and rows grow downward.
    pub weights: Vec<Vec<f64>>,
}

/// One transition of a model of hazards: the ways in which a cell changes from one state to another.
///
/// The transition happens in a step with probability `1 - (1 - base) prod (1 - p)`. The product is over all neighbours,
/// and `p` is the entry of `near` for the neighbour's state and place.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TransitionEntry {
    /// Name of the cell's state at step k.
    pub from: String,
    /// Name of the cell's state at step k + 1.
    pub to: String,
    /// Probability without any influence of neighbours.
    #[serde(default)]
    pub base: f64,
    /// Names of the maps that multiply `-log(1 - p)` of the probabilities. A map `[H, W]` multiplies those of `base` and
    /// `near`; a map `[KH, KW, H, W]` those of `near`, each place of a neighbour by its own factors.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub times: Vec<String>,
    /// For names of states, the probability `p` with which one neighbour in that state causes the transition, as
    /// `[row offset][column offset]`. The centre is the cell itself and has 0, and rows grow downward.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub near: BTreeMap<String, Vec<Vec<f64>>>,
}

#[derive(Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum ModelError {
    /// The text is not TOML, or lacks the structure of a model file.
    #[error("model file: {0}")]
    Toml(String),
    #[error(
        "model {:?}: expected {least} to {most} {what}, got {got}",
        shortened(model)
    )]
    Count {
        model: String,
        what: &'static str,
        least: usize,
        most: usize,
        got: usize,
    },
    #[error(
        "model {:?}: {what} name {:?} appears twice",
        shortened(model),
        shortened(name)
    )]
    DuplicateName {
        model: String,
        what: &'static str,
        name: String,
    },
    /// A file cannot be read.
    #[error("{}: {problem}", shortened(path))]
    File { path: String, problem: String },
    #[error(
        "model {:?}: {}: expected {expected}, got {}",
        shortened(model),
        shortened(what),
        shortened(got)
    )]
    Value {
        model: String,
        what: String,
        expected: String,
        got: String,
    },
    /// The transition weights of a cell can all be zero: eq. 3 would divide by zero.
    #[error(
        "model {model:?} on a {shape} grid: transition weights of cell {cell} can sum to zero, \
         expected a positive sum for every neighbourhood: give the centre of the kernel a \
         positive weight from every state, or give a state a bias"
    )]
    ZeroWeight {
        model: String,
        shape: Shape,
        cell: Cell,
    },
    /// The transition weights of a cell can all be so small that eq. 3 divides by rounding errors.
    #[error(
        "model {model:?} on a {shape} grid: transition weights of cell {cell} can sum to {share:e} times \
         the largest weight, expected at least {LEAST_SHARE:e} times for every neighbourhood: raise the small weights"
    )]
    FaintWeight {
        model: String,
        shape: Shape,
        cell: Cell,
        /// The smallest sum of the cell's weights, relative to the largest weight.
        share: f64,
    },
}

/// The form of transitions, for advice about files.
pub const TRANSITIONS_FORM: &str = r#"
    maps = "land.npz"        # arrays [H, W] or [KH, KW, H, W]

    [[transitions]]
    from = "unburnt"
    to = "burning"
    base = 0.00004           # probability a step
    near.burning = [[0.05, 0.03, 0.01], [0.08, 0.0, 0.01], [0.05, 0.03, 0.01]]    # by one neighbour
    times = ["fuel"]
"#;

impl From<toml::de::Error> for ModelError {
    /// Adds advice if the text contains a key of earlier releases.
    fn from(error: toml::de::Error) -> Self {
        let mut text = parse_problem(&error) + "\n";
        let has = |keys: &[&str]| {
            keys.iter()
                .any(|key| error.message().contains(&format!("field `{key}`")))
        };
        if has(&["rings", "pays"]) {
            text += "remove `rings` and `pays`: a sensor has one observation matrix, and rewards are for \
                     visited cells\n";
        }
        if has(&["own", "zone", "zones", "zone_map"]) {
            text += "kernels by own state and zones are now transitions, with a map for what differs between cells:\n";
            text += TRANSITIONS_FORM;
        }
        Self::Toml(text)
    }
}

impl ModelFile {
    /// Reads a model file, and the map files in its folder. [`super::Model::new`] checks the entries.
    ///
    /// # Errors
    /// If a file cannot be read or parsed.
    pub fn read(path: &Path) -> Result<Self, ModelError> {
        let failed = |key: &str, path: &Path, problem: String| ModelError::File {
            path: format!("{key}{}", path.display()),
            problem,
        };
        let text = read_text(path).map_err(|error| failed("", path, error.to_string()))?;
        let mut file: Self = toml::from_str(&text)?;
        if let Some(map) = &mut file.no_fly {
            map.read_beside(path)
                .map_err(|(path, problem)| failed("no_fly: ", &path, problem))?;
        }
        if let Some(maps) = &mut file.maps {
            maps.read_beside(path)
                .map_err(|(path, problem)| failed("maps: ", &path, problem))?;
        }
        Ok(file)
    }
}

impl KernelEntry {
    pub(super) fn what(&self) -> String {
        format!("kernel from {:?} to {:?}", self.from, self.to)
    }
}

impl TransitionEntry {
    pub(super) fn what(&self) -> String {
        format!("transition from {:?} to {:?}", self.from, self.to)
    }
}

/// Parses a colour `#rrggbb` to `[red, green, blue]`.
pub fn parse_color(text: &str) -> Option<[u8; 3]> {
    let digits = text
        .strip_prefix('#')
        .filter(|digits| digits.len() == 6 && digits.bytes().all(|d| d.is_ascii_hexdigit()))?;
    let channel = |at: usize| u8::from_str_radix(&digits[at..at + 2], 16).ok();
    Some([channel(0)?, channel(2)?, channel(4)?])
}

fn one() -> f64 {
    1.0
}
