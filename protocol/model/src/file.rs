//! The format of a model file in TOML, and its errors.

use super::cell_map::CellMap;
use super::grid::{Cell, Shape};
use crate::text::{parse_problem, read_text, shortened};
use serde::{Deserialize, Serialize};
use std::path::Path;
use thiserror::Error;

/// Maximum number of states, and of observations: 64.
pub const MAX_VALUES: usize = 64;

/// Maximum side of a kernel: 15 cells.
pub const MAX_KERNEL_SIDE: usize = 15;

/// Minimum sum of a cell's weights, relative to the largest weight. The smallest normal `f32` is 1e-38, so larger sums
/// keep their precision.
pub(super) const LEAST_SHARE: f64 = 1e-30;

/// Maximum number of zones: the number of values of a byte.
pub const MAX_ZONES: usize = 256;

/// Maximum radius of a sensor: 8 cells.
pub const MAX_RADIUS: usize = 8;

/// A model as written in TOML; [`super::Model::new`] checks it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelFile {
    /// Name for display.
    pub name: String,
    /// Number of rows and columns of the transition kernel, both odd.
    pub kernel_size: [usize; 2],
    /// Name of the state of all cells outside the grid. Without it, these cells add no weight.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub edge: Option<String>,
    /// The zone of each cell, as an index in `zones`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub zone_map: Option<CellMap>,
    /// No-fly map: 1 for each cell closed to robots.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub no_fly: Option<CellMap>,
    /// The sensor of a robot. Without it, a robot sees the cells of its path.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sensor: Option<SensorEntry>,
    /// Kinds of land, each with separate kernels.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub zones: Vec<ZoneEntry>,
    /// The states, in the order of their values.
    pub states: Vec<StateEntry>,
    /// The observations, in the order of their values.
    pub observations: Vec<ObservationEntry>,
    /// The nonzero blocks `w[to, from]` of the kernels.
    pub kernel: Vec<KernelEntry>,
}

/// One state of a model file.
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

/// One observation of a model file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObservationEntry {
    /// Name, unique among the observations.
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

/// A kind of land in a model file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ZoneEntry {
    /// Name, unique among the zones.
    pub name: String,
    /// Colour in pictures, `#rrggbb`.
    pub color: String,
}

/// One block `w[to, from]` of a kernel in a model file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KernelEntry {
    /// Name of the zone. Either every entry of a file names a zone, or none does.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub zone: Option<String>,
    /// Name of the cell's own state at step k. Either every entry of a file has it, or none does.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub own: Option<String>,
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

/// The reason for rejecting a model file.
#[derive(Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum ModelError {
    /// The text is not TOML, or lacks the structure of a model file.
    #[error("model file: {0}")]
    Toml(String),
    /// There are too few or too many states or observations.
    #[error(
        "model {:?}: expected {least} to {most} {what}, got {got}",
        shortened(model)
    )]
    Count {
        /// The model's name.
        model: String,
        /// `states` or `observations`.
        what: &'static str,
        /// Smallest number allowed.
        least: usize,
        /// Largest number allowed.
        most: usize,
        /// Number in the file.
        got: usize,
    },
    /// Two entries have the same name.
    #[error(
        "model {:?}: {what} name {:?} appears twice",
        shortened(model),
        shortened(name)
    )]
    DuplicateName {
        /// The model's name.
        model: String,
        /// `state` or `observation`.
        what: &'static str,
        /// The repeated name.
        name: String,
    },
    /// A file cannot be read.
    #[error("{}: {problem}", shortened(path))]
    File {
        /// The file.
        path: String,
        /// The system's error.
        problem: String,
    },
    /// A kernel entry names an unknown state.
    #[error(
        "model {:?}: kernel entry names state {:?}, expected one of {}",
        shortened(model),
        shortened(name),
        shortened(&format!("{known:?}"))
    )]
    UnknownState {
        /// The model's name.
        model: String,
        /// The name in the kernel entry.
        name: String,
        /// The model's states.
        known: Vec<String>,
    },
    /// An entry has a wrong value.
    #[error(
        "model {:?}: {}: expected {expected}, got {}",
        shortened(model),
        shortened(what),
        shortened(got)
    )]
    Value {
        /// The model's name.
        model: String,
        /// The entry.
        what: String,
        /// The expected value.
        expected: String,
        /// The given value.
        got: String,
    },
    /// The transition weights of a cell can all be zero: eq. 3 would divide by zero.
    #[error(
        "model {model:?} on a {shape} grid: transition weights of cell {cell} can sum to zero, \
         expected a positive sum for every neighbourhood: give the centre of the kernel a \
         positive weight from every state, or give a state a bias"
    )]
    ZeroWeight {
        /// The model's name.
        model: String,
        /// The grid.
        shape: Shape,
        /// The first such cell.
        cell: Cell,
    },
    /// The transition weights of a cell can all be so small that eq. 3 divides by rounding errors.
    #[error(
        "model {model:?} on a {shape} grid: transition weights of cell {cell} can sum to {share:e} times \
         the largest weight, expected at least {LEAST_SHARE:e} times for every neighbourhood: raise the small weights"
    )]
    FaintWeight {
        /// The model's name.
        model: String,
        /// The grid.
        shape: Shape,
        /// The first such cell.
        cell: Cell,
        /// The smallest sum of the cell's weights, relative to the largest weight.
        share: f64,
    },
}

impl From<toml::de::Error> for ModelError {
    /// Adds advice if the text contains a key of earlier releases.
    fn from(error: toml::de::Error) -> Self {
        let mut text = parse_problem(&error) + "\n";
        if ["`rings`", "`pays`"]
            .iter()
            .any(|key| error.message().contains(key))
        {
            text += "remove `rings` and `pays`: a sensor has one observation matrix, and rewards are for \
                     visited cells\n";
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
        let failed = |path: &Path, problem: String| ModelError::File {
            path: path.display().to_string(),
            problem,
        };
        let text = read_text(path).map_err(|error| failed(path, error.to_string()))?;
        let mut file: Self = toml::from_str(&text)?;
        for map in [&mut file.zone_map, &mut file.no_fly].into_iter().flatten() {
            let read = map.read_beside(path);
            read.map_err(|(path, problem)| failed(&path, problem))?;
        }
        Ok(file)
    }
}

impl KernelEntry {
    /// Returns the name of the entry for errors.
    pub(super) fn what(&self) -> String {
        let pair = format!("from {:?} to {:?}", self.from, self.to);
        let zone = self.zone.iter().map(|zone| format!("in zone {zone:?} "));
        let zone: String = zone.collect();
        match &self.own {
            Some(own) => format!("kernel {zone}of {own:?} {pair}"),
            None => format!("kernel {zone}{pair}"),
        }
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
