//! The model file in TOML, and the errors in one.

use super::cell_map::CellMap;
use super::grid::{Cell, Shape};
use crate::text::read_text;
use serde::{Deserialize, Serialize};
use std::path::Path;
use thiserror::Error;

/// Most states, and most observations, of a model: 64.
pub const MAX_VALUES: usize = 64;

/// Largest kernel side: 15 cells.
pub const MAX_KERNEL_SIDE: usize = 15;

/// The least that the weights of a cell may sum to, as a share of the largest weight: the smallest
/// normal `f32` is 1e-38, so that sums from 1e-30 on keep their precision in beliefs.
pub(super) const LEAST_SHARE: f64 = 1e-30;

/// Most zones: as many as a byte tells apart.
pub const MAX_ZONES: usize = 256;

/// Largest radius of a sensor: 8 cells.
pub const MAX_RADIUS: usize = 8;

/// A model as written in TOML; [`super::Model::new`] checks it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelFile {
    /// Name shown to people.
    pub name: String,
    /// Rows and columns of the transition kernel, both odd.
    pub kernel_size: [usize; 2],
    /// Name of the state that cells outside the grid are always in; without it, they add no weight.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub edge: Option<String>,
    /// The zone of each cell: its place in `zones`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub zone_map: Option<CellMap>,
    /// 1 for each cell where no robot may be.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub no_fly: Option<CellMap>,
    /// What a robot sees; without it, the cells of its path.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sensor: Option<SensorEntry>,
    /// Kinds of land, each with kernels of its own.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub zones: Vec<ZoneEntry>,
    /// The states, in the order of their values.
    pub states: Vec<StateEntry>,
    /// The observations, in the order of their values.
    pub observations: Vec<ObservationEntry>,
    /// The blocks `w[to, from]` of the kernel that are not zero.
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

/// What a robot sees from its path.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SensorEntry {
    /// Rows and columns that it sees beyond each cell of the path (a Chebyshev distance).
    #[serde(default)]
    pub radius: usize,
    /// The cells that pay.
    #[serde(default)]
    pub pays: Pays,
    /// The observation matrix of ring 1, 2 and so on; the last holds for the rings beyond. Without one, `observed_as`
    /// of the states holds everywhere.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub rings: Vec<RingEntry>,
}

/// The observation matrix of a ring.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RingEntry {
    /// `P(y | x)`: a row for each state, one entry per observation.
    pub observed_as: Vec<Vec<f64>>,
}

/// The distinct cells that earn their states' rewards.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Pays {
    /// Those on the path.
    #[default]
    Visited,
    /// Those in sight of the path.
    Seen,
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

/// One block `w[to, from]` of the kernel in a model file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KernelEntry {
    /// Name of the zone; in all entries of a file, or in none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub zone: Option<String>,
    /// Name of the state that the cell itself is in at k; in all entries of a file, or in none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub own: Option<String>,
    /// Name of the state at k.
    pub from: String,
    /// Name of the state at k + 1.
    pub to: String,
    /// Factor on every weight.
    #[serde(default = "one")]
    pub scale: f64,
    /// Weights `[row offset][column offset]`; the centre is the cell itself, rows grow downward.
    pub weights: Vec<Vec<f64>>,
}

/// Why a model file was rejected.
#[derive(Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum ModelError {
    /// Not TOML, or not of the model's form.
    #[error("model file: {0}")]
    Toml(String),
    /// Too few or too many states or observations.
    #[error("model {model:?}: expected {least} to {most} {what}, got {got}")]
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
    /// Two entries with one name.
    #[error("model {model:?}: {what} name {name:?} stands twice")]
    DuplicateName {
        /// The model's name.
        model: String,
        /// `state` or `observation`.
        what: &'static str,
        /// The repeated name.
        name: String,
    },
    /// A file that cannot be read.
    #[error("{path}: {problem}")]
    File {
        /// The file.
        path: String,
        /// Why not.
        problem: String,
    },
    /// A kernel entry that names a state the model lacks.
    #[error("model {model:?}: kernel entry names state {name:?}, expected one of {known:?}")]
    UnknownState {
        /// The model's name.
        model: String,
        /// The name in the kernel entry.
        name: String,
        /// The model's states.
        known: Vec<String>,
    },
    /// A number or a size that cannot be right.
    #[error("model {model:?}: {what}: expected {expected}, got {got}")]
    Value {
        /// The model's name.
        model: String,
        /// Which entry.
        what: String,
        /// What it must be.
        expected: String,
        /// What it is.
        got: String,
    },
    /// A cell whose transition weights can all be zero: eq. 3 would divide by zero.
    #[error(
        "model {model:?} on a {shape} grid: transition weights of cell {cell} can sum to zero, \
         expected a positive sum whatever its neighbourhood: give the centre of the kernel a \
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
    /// A cell whose transition weights can all be so small that eq. 3 divides noise by noise.
    #[error(
        "model {model:?} on a {shape} grid: transition weights of cell {cell} can sum to {share:e} of \
         the largest weight, expected at least {LEAST_SHARE:e} whatever its neighbourhood"
    )]
    FaintWeight {
        /// The model's name.
        model: String,
        /// The grid.
        shape: Shape,
        /// The first such cell.
        cell: Cell,
        /// What its weights can sum to, as a share of the largest weight.
        share: f64,
    },
}

impl ModelFile {
    /// Reads a model file, and the maps that stand beside it.
    ///
    /// # Errors
    /// If a file cannot be read or is not of its form. What it says is yet to be checked.
    pub fn read(path: &Path) -> Result<Self, ModelError> {
        let failed = |path: &Path, problem: String| ModelError::File {
            path: path.display().to_string(),
            problem,
        };
        let text = read_text(path).map_err(|error| failed(path, error.to_string()))?;
        let mut file: Self =
            toml::from_str(&text).map_err(|error| ModelError::Toml(error.to_string()))?;
        for map in [&mut file.zone_map, &mut file.no_fly].into_iter().flatten() {
            let read = map.read_beside(path);
            read.map_err(|(path, problem)| failed(&path, problem))?;
        }
        Ok(file)
    }
}

impl KernelEntry {
    /// Names the entry in errors.
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

/// Colour of a `#rrggbb` text as `[red, green, blue]`.
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
