//! The hidden Markov model on a grid: its parameters, their file format and their checks.
//!
//! Paper section II: states with the transition kernel `w` and bias `b` of eq. 2, and the observation
//! matrix `O` of eq. 1. What the parameters do lives in [`crate::transition`] (on beliefs) and
//! [`crate::dynamics`] (on realised states).

use crate::grid::{Cell, Shape};
use ndarray::{Array1, Array2, Array4, Axis};
use serde::{Deserialize, Serialize};
use std::ops::RangeInclusive;
use thiserror::Error;

/// Most states, and most observations, of a model: 64.
pub const MAX_VALUES: usize = 64;

/// Largest kernel side: 15 cells.
pub const MAX_KERNEL_SIDE: usize = 15;

/// Range of weights and biases that are not zero, and of the size of rewards: no sum or product of
/// those overflows or vanishes in `f64`.
const RANGE: RangeInclusive<f64> = 1e-100..=1e100;

/// The least that the weights of a cell may sum to, as a share of the largest weight: the smallest
/// normal `f32` is 1e-38, so that sums from 1e-30 on keep their precision in beliefs.
const LEAST_SHARE: f64 = 1e-30;

/// How far a probability distribution in a model file may be from summing to one.
const SUM_TOLERANCE: f64 = 1e-6;

const WILDFIRE: &str = include_str!("../../config/models/wildfire.toml");

/// A checked model: every model that exists can be simulated and filtered.
#[derive(Debug, Clone, PartialEq)]
pub struct Model {
    file: ModelFile,
    kernel: Array4<f64>,
    bias: Array1<f64>,
    likelihood: Array2<f64>,
    initial: Array1<f64>,
    reward: Array1<f64>,
}

/// A model as written in TOML; [`Model::new`] checks it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelFile {
    /// Name shown to people.
    pub name: String,
    /// Rows and columns of the transition kernel, both odd.
    pub kernel_size: [usize; 2],
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
    /// Name, unique among the states.
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

/// One block `w[to, from]` of the kernel in a model file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KernelEntry {
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
    #[error("model {model:?}: expected {least} to {MAX_VALUES} {what}, got {got}")]
    Count {
        /// The model's name.
        model: String,
        /// `states` or `observations`.
        what: &'static str,
        /// Smallest number allowed.
        least: usize,
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

impl Model {
    /// The built-in wildfire model (`config/models/wildfire.toml`).
    pub fn wildfire() -> Self {
        Self::from_toml(WILDFIRE).expect("invariant: the built-in model is valid, as a test shows")
    }

    /// Reads and checks a model file's text.
    ///
    /// # Errors
    /// [`ModelError`] names the entry, what it must be and what it is.
    pub fn from_toml(text: &str) -> Result<Self, ModelError> {
        let file = toml::from_str(text).map_err(|error| ModelError::Toml(error.to_string()))?;
        Self::new(file)
    }

    /// Checks a model file and lays out its arrays.
    ///
    /// # Errors
    /// [`ModelError`] names the entry, what it must be and what it is.
    pub fn new(file: ModelFile) -> Result<Self, ModelError> {
        let check = Checker { model: &file.name };
        check.counts_and_names(&file)?;
        let kernel = check.kernel(&file)?;
        let bias = check.per_state(&file, "bias", |state| state.bias, 0.0)?;
        let reward = check.per_state(&file, "reward", |state| state.reward, f64::NEG_INFINITY)?;
        let initial = check.per_state(&file, "initial", |state| state.initial, 0.0)?;
        check.distribution("initial", initial.as_slice().unwrap_or_default())?;
        let likelihood = check.likelihood(&file)?;
        let initial = &initial / initial.sum();
        Ok(Self {
            file,
            kernel,
            bias,
            likelihood,
            initial,
            reward,
        })
    }

    /// Checks that eq. 3 never divides by zero on a grid, or by next to nothing, whatever the states.
    ///
    /// # Errors
    /// [`ModelError::ZeroWeight`] or [`ModelError::FaintWeight`] names the first cell where it can.
    pub fn check_on(&self, shape: Shape) -> Result<(), ModelError> {
        let column_sums = self.kernel.sum_axis(Axis(0));
        let least = column_sums.fold_axis(Axis(0), f64::INFINITY, |a, b| a.min(*b));
        let (kernel_height, kernel_width) = least.dim();
        let largest = self.kernel.iter().chain(&self.bias).copied();
        let largest = largest.fold(f64::MIN_POSITIVE, f64::max);
        // Cells further than a kernel from the edges are all alike: look at one of them.
        let distinct = |side: usize, kernel: usize| {
            (0..side).filter(move |&at| at <= kernel || at + kernel >= side)
        };
        for row in distinct(shape.height(), kernel_height) {
            for col in distinct(shape.width(), kernel_width) {
                let on_grid = least.indexed_iter().filter(|&((i, j), _)| {
                    let (i, j) = (row + i, col + j);
                    let (up, left) = (kernel_height / 2, kernel_width / 2);
                    (up..shape.height() + up).contains(&i)
                        && (left..shape.width() + left).contains(&j)
                });
                let sum = self.bias.sum() + on_grid.map(|(_, weight)| weight).sum::<f64>();
                self.check_share(sum / largest, shape, Cell { row, col })?;
            }
        }
        Ok(())
    }

    /// Checks the least share of the largest weight that a cell's weights can sum to.
    fn check_share(&self, share: f64, shape: Shape, cell: Cell) -> Result<(), ModelError> {
        let model = || self.name().into();
        if share <= 0.0 {
            let model = model();
            return Err(ModelError::ZeroWeight { model, shape, cell });
        }
        if share < LEAST_SHARE {
            return Err(ModelError::FaintWeight {
                model: model(),
                shape,
                cell,
                share,
            });
        }
        Ok(())
    }

    /// The model's name.
    pub fn name(&self) -> &str {
        &self.file.name
    }

    /// The file that the model was made from; serialises to a model file again.
    pub fn file(&self) -> &ModelFile {
        &self.file
    }

    /// Number of states S.
    pub fn n_states(&self) -> usize {
        self.file.states.len()
    }

    /// Number of observations O.
    pub fn n_observations(&self) -> usize {
        self.file.observations.len()
    }

    /// Transition weights `w[to, from, row, col]`, shape `[S, S, KH, KW]`, all `>= 0` (eq. 2).
    pub fn kernel(&self) -> &Array4<f64> {
        &self.kernel
    }

    /// Transition bias `b[to]`, shape `[S]`, all `>= 0` (eq. 2).
    pub fn bias(&self) -> &Array1<f64> {
        &self.bias
    }

    /// `P(y | x)`, shape `[S, O]`; each row sums to one (eq. 1).
    pub fn likelihood(&self) -> &Array2<f64> {
        &self.likelihood
    }

    /// Distribution of each cell at the start of burn-in, shape `[S]`.
    pub fn initial(&self) -> &Array1<f64> {
        &self.initial
    }

    /// Reward for each distinct visited cell by its state, shape `[S]`.
    pub fn reward(&self) -> &Array1<f64> {
        &self.reward
    }

    /// The state that pays most (the first of them): fire in the wildfire model.
    pub fn target_state(&self) -> usize {
        let better = |best, state| {
            if self.reward[state] > self.reward[best] {
                state
            } else {
                best
            }
        };
        (0..self.n_states()).fold(0, better)
    }

    /// The state of a name.
    pub fn state_named(&self, name: &str) -> Option<usize> {
        self.file.states.iter().position(|state| state.name == name)
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

/// The checks of [`Model::new`]; each returns what it checked.
struct Checker<'a> {
    model: &'a str,
}

impl Checker<'_> {
    fn wrong<T>(&self, what: String, expected: &str, got: impl ToString) -> Result<T, ModelError> {
        let (model, expected, got) = (self.model.into(), expected.into(), got.to_string());
        Err(ModelError::Value {
            model,
            what,
            expected,
            got,
        })
    }

    fn counts_and_names(&self, file: &ModelFile) -> Result<(), ModelError> {
        let states: Vec<_> = file.states.iter().map(|s| (&s.name, &s.color)).collect();
        let observations: Vec<_> = file
            .observations
            .iter()
            .map(|o| (&o.name, &o.color))
            .collect();
        self.entries("state", "states", 2, &states)?;
        self.entries("observation", "observations", 1, &observations)
    }

    fn entries(
        &self,
        what: &'static str,
        plural: &'static str,
        least: usize,
        entries: &[(&String, &String)],
    ) -> Result<(), ModelError> {
        let got = entries.len();
        if !(least..=MAX_VALUES).contains(&got) {
            return Err(ModelError::Count {
                model: self.model.into(),
                what: plural,
                least,
                got,
            });
        }
        for (index, &(name, color)) in entries.iter().enumerate() {
            if entries[..index].iter().any(|(earlier, _)| *earlier == name) {
                let (model, name) = (self.model.into(), name.clone());
                return Err(ModelError::DuplicateName { model, what, name });
            }
            if parse_color(color).is_none() {
                return self.wrong(format!("{what} {name:?}: color"), "#rrggbb", color);
            }
        }
        Ok(())
    }

    fn per_state(
        &self,
        file: &ModelFile,
        what: &str,
        value: impl Fn(&StateEntry) -> f64,
        least: f64,
    ) -> Result<Array1<f64>, ModelError> {
        for state in &file.states {
            let got = value(state);
            let what = format!("state {:?}: {what}", state.name);
            if !got.is_finite() || got < least {
                let expected = if least == 0.0 {
                    "a finite number >= 0"
                } else {
                    "a finite number"
                };
                return self.wrong(what, expected, got);
            }
            self.size(what, got, got == 0.0)?;
        }
        Ok(file.states.iter().map(value).collect())
    }

    /// Checks that a number is neither too small nor too large to compute with.
    fn size(&self, what: String, got: f64, is_zero: bool) -> Result<(), ModelError> {
        if is_zero || RANGE.contains(&got.abs()) {
            return Ok(());
        }
        let expected = format!("0, or a size of {:e} to {:e}", RANGE.start(), RANGE.end());
        self.wrong(what, &expected, format!("{got:e}"))
    }

    fn distribution(&self, what: &str, values: &[f64]) -> Result<(), ModelError> {
        if values.iter().any(|v| !v.is_finite() || *v < 0.0) {
            return self.wrong(what.into(), "probabilities >= 0", format!("{values:?}"));
        }
        let sum: f64 = values.iter().sum();
        if (sum - 1.0).abs() > SUM_TOLERANCE {
            return self.wrong(what.into(), "a sum of 1", sum);
        }
        Ok(())
    }

    fn likelihood(&self, file: &ModelFile) -> Result<Array2<f64>, ModelError> {
        let n_observations = file.observations.len();
        let mut likelihood = Array2::zeros((file.states.len(), n_observations));
        for (state, mut row) in file.states.iter().zip(likelihood.rows_mut()) {
            let what = format!("state {:?}: observed_as", state.name);
            if state.observed_as.len() != n_observations {
                let expected = format!("{n_observations} probabilities, one per observation");
                return self.wrong(what, &expected, state.observed_as.len());
            }
            self.distribution(&what, &state.observed_as)?;
            let sum: f64 = state.observed_as.iter().sum();
            row.iter_mut()
                .zip(&state.observed_as)
                .for_each(|(to, p)| *to = p / sum);
        }
        Ok(likelihood)
    }

    fn kernel(&self, file: &ModelFile) -> Result<Array4<f64>, ModelError> {
        let [height, width] = file.kernel_size;
        let odd = |side: usize| side % 2 == 1 && side <= MAX_KERNEL_SIDE;
        if !odd(height) || !odd(width) {
            let expected = format!("two odd numbers up to {MAX_KERNEL_SIDE}");
            return self.wrong(
                "kernel_size".into(),
                &expected,
                format!("{:?}", file.kernel_size),
            );
        }
        let n_states = file.states.len();
        let mut kernel = Array4::zeros((n_states, n_states, height, width));
        let mut filled = Array2::from_elem((n_states, n_states), false);
        for entry in &file.kernel {
            let block = [self.state(file, &entry.to)?, self.state(file, &entry.from)?];
            if std::mem::replace(&mut filled[block], true) {
                return self.wrong(entry.what(), "one entry for each pair of states", "two");
            }
            for (row, col, weight) in self.weights(entry, file.kernel_size)? {
                kernel[[block[0], block[1], row, col]] = weight;
            }
        }
        Ok(kernel)
    }

    fn weights(
        &self,
        entry: &KernelEntry,
        [height, width]: [usize; 2],
    ) -> Result<Vec<(usize, usize, f64)>, ModelError> {
        let is_block =
            entry.weights.len() == height && entry.weights.iter().all(|row| row.len() == width);
        if !is_block {
            let got: Vec<usize> = entry.weights.iter().map(Vec::len).collect();
            let expected = format!("{height} rows of {width} weights");
            return self.wrong(entry.what(), &expected, format!("rows of {got:?}"));
        }
        let mut weights = Vec::with_capacity(height * width);
        for (row, values) in entry.weights.iter().enumerate() {
            for (col, value) in values.iter().enumerate() {
                let weight = value * entry.scale;
                if !weight.is_finite() || weight < 0.0 {
                    return self.wrong(entry.what(), "finite weights >= 0", weight);
                }
                self.size(entry.what(), weight, *value == 0.0 || entry.scale == 0.0)?;
                weights.push((row, col, weight));
            }
        }
        Ok(weights)
    }

    fn state(&self, file: &ModelFile, name: &str) -> Result<usize, ModelError> {
        let found = file.states.iter().position(|state| state.name == name);
        found.ok_or_else(|| ModelError::UnknownState {
            model: self.model.into(),
            name: name.into(),
            known: file.states.iter().map(|state| state.name.clone()).collect(),
        })
    }
}

impl KernelEntry {
    fn what(&self) -> String {
        format!("kernel from {:?} to {:?}", self.from, self.to)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_built_in_model_has_the_published_parameters() {
        // DESIGN: g = 0.1, a0 = 0.9999, a1 = 0.99992, a2 = 0.999; the authors' kernel.
        let model = Model::wildfire();
        let around = [[0.1, 0.1, 0.1], [0.1, 1.0, 0.1], [0.1, 0.1, 0.1]];
        let drift = [[0.12, 0.12, 0.12], [0.1, 1.0, 0.1], [0.08, 0.08, 0.08]];
        let blocks = [
            (0, 0, 0.9999, around),
            (0, 2, 1.0 - 0.9999, around),
            (1, 1, 0.99992, around),
            (1, 0, 1.0 - 0.99992, around),
            (2, 1, 1.0 - 0.999, around),
            (2, 2, 0.999, drift),
        ];
        let mut expected = Array4::<f64>::zeros((3, 3, 3, 3));
        for (to, from, scale, block) in blocks {
            for (row, values) in block.iter().enumerate() {
                for (col, value) in values.iter().enumerate() {
                    expected[[to, from, row, col]] = scale * value;
                }
            }
        }
        assert!((&expected - model.kernel()).iter().all(|d| d.abs() < 1e-12));
        assert_eq!(model.likelihood().row(1).to_vec(), [0.80, 0.15, 0.05]);
        assert_eq!(model.initial().to_vec(), [0.99, 0.01, 0.0]);
        assert_eq!(model.target_state(), 2);
    }

    fn check(change: impl FnOnce(&mut ModelFile), expected: &str) {
        let mut file = Model::wildfire().file;
        change(&mut file);
        let error = Model::new(file)
            .expect_err("the change must be rejected")
            .to_string();
        assert!(
            error.contains(expected),
            "{error:?} does not say {expected:?}"
        );
    }

    #[test]
    fn wrong_entries_are_rejected_by_name() {
        check(|f| f.states.truncate(1), "expected 2 to 64 states, got 1");
        check(
            |f| f.states[1].name = "normal".into(),
            "state name \"normal\" stands twice",
        );
        check(
            |f| f.kernel[0].weights[0][1] = -0.1,
            "kernel from \"normal\" to \"normal\": expected finite weights >= 0, got -0.",
        );
        check(|f| f.kernel[0].scale = f64::NAN, "got NaN");
        check(|f| f.kernel[0].to = "ash".into(), "names state \"ash\"");
        check(
            |f| f.kernel_size = [2, 3],
            "two odd numbers up to 15, got [2, 3]",
        );
        check(
            |f| f.states[2].observed_as = vec![0.5, 0.4, 0.0],
            "observed_as: expected a sum of 1, got 0.9",
        );
        check(
            |f| f.states[2].observed_as = vec![1.0],
            "expected 3 probabilities",
        );
        check(
            |f| f.states[0].initial = 0.5,
            "initial: expected a sum of 1, got 0.51",
        );
        check(|f| f.states[0].bias = -1.0, "state \"normal\": bias");
        check(
            |f| f.states[0].color = "red".into(),
            "expected #rrggbb, got red",
        );
        check(|f| f.states[0].color = "#+1+2+3".into(), "got #+1+2+3");
        check(
            |f| f.kernel.push(f.kernel[0].clone()),
            "expected one entry for each pair of states, got two",
        );
    }

    #[test]
    fn numbers_too_large_or_too_small_to_compute_with_are_rejected() {
        let around = "0, or a size of 1e-100 to 1e100";
        for (number, shown) in [(1e101, "e101"), (1e-320, "e-320")] {
            check(|f| f.states[0].bias = number, around);
            check(|f| f.states[2].reward = -number, shown);
            check(|f| f.kernel[0].weights[1][1] = number, around);
        }
        // Each factor is in range, their product vanishes.
        check(
            |f| {
                f.kernel[0].scale = 1e-99;
                f.kernel[0].weights = vec![vec![1e-99; 3]; 3];
            },
            "kernel from \"normal\" to \"normal\": expected 0, or a size of",
        );
    }

    #[test]
    fn weights_that_can_vanish_beside_the_largest_are_rejected() {
        let mut file = Model::wildfire().file;
        for entry in file.kernel.iter_mut().filter(|e| e.from == "latent") {
            entry.scale *= 1e-31;
        }
        let shape = Shape::new(4, 4).expect("test shape");
        let error = Model::new(file.clone()).expect("valid until a grid is named");
        let error = error.check_on(shape).expect_err("a cell among latent ones");
        assert!(
            matches!(error, ModelError::FaintWeight { share, .. } if share > 0.0),
            "{error}"
        );
        file.states[0].bias = 1e-6;
        let rescued = Model::new(file).expect("valid");
        assert_eq!(rescued.check_on(shape), Ok(()));
    }

    #[test]
    fn weights_that_can_sum_to_zero_are_rejected_on_the_grid_where_they_can() {
        let mut file = Model::wildfire().file;
        for entry in &mut file.kernel {
            entry.weights[1][1] = 0.0;
        }
        let model = Model::new(file).expect("valid until a grid is named");
        let shape = |height, width| Shape::new(height, width).expect("test shape");
        assert_eq!(model.check_on(shape(5, 9)), Ok(()));
        let error = model
            .check_on(shape(1, 1))
            .expect_err("a cell without neighbours");
        assert!(error.to_string().contains("cell (0, 0)"), "{error}");
        assert_eq!(Model::wildfire().check_on(shape(1, 1)), Ok(()));
    }

    #[test]
    fn a_model_file_survives_toml() {
        let model = Model::wildfire();
        let text = toml::to_string(model.file()).expect("models serialise");
        assert_eq!(Model::from_toml(&text), Ok(model));
        assert!(matches!(
            Model::from_toml("name = 3"),
            Err(ModelError::Toml(_))
        ));
    }
}
