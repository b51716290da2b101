//! The parameters of the hidden Markov model on a grid, for simulators and filters.
//!
//! Paper section II: states with the transition kernel `w` and bias `b` of eq. 2, and the observation matrix `O` of eq. 1.
//! [`super::file`] is the file format. [`super::transition`] applies them to beliefs, [`super::dynamics`] to states.

use super::airspace::Airspace;
use super::built_in::MODELS;
use super::check::Checker;
use super::file::{LEAST_SHARE, ModelError, ModelFile};
use super::grid::{Cell, Grid, Shape};
use ndarray::{Array1, Array2, Array4, Axis};
use std::path::Path;
use std::sync::Arc;

/// A checked model: every model that exists can be simulated and filtered.
#[derive(Debug, Clone, PartialEq)]
pub struct Model {
    file: ModelFile,
    kernels: Vec<Array4<f64>>,
    bias: Array1<f64>,
    likelihood: Array2<f64>,
    initial: Array1<f64>,
    reward: Array1<f64>,
    edge: Option<usize>,
    zone_map: Option<Arc<Grid<u8>>>,
    /// Where no robot may be.
    no_fly: Option<Arc<Grid<bool>>>,
}

impl Model {
    /// The built-in wildfire model (`config/models/wildfire.toml`).
    pub fn wildfire() -> Self {
        Self::built_in("wildfire").expect("invariant: the wildfire is built in")
    }

    /// The built-in model of a name (`config/models`).
    pub fn built_in(name: &str) -> Option<Self> {
        let (_, text) = MODELS.iter().find(|(known, _)| *known == name)?;
        let model = Self::from_toml(text);
        Some(model.expect("invariant: built-in models are valid, as a test shows"))
    }

    /// The names of the built-in models.
    pub fn built_in_names() -> impl Iterator<Item = &'static str> {
        Self::built_in_files().map(|(name, _)| name)
    }

    /// The built-in models: name, and text of the file.
    pub fn built_in_files() -> impl Iterator<Item = (&'static str, &'static str)> {
        MODELS.iter().copied()
    }

    /// Reads and checks a model file's text.
    ///
    /// # Errors
    /// If an entry is wrong; the error names it, what it must be and what it is.
    pub fn from_toml(text: &str) -> Result<Self, ModelError> {
        let file = toml::from_str(text).map_err(|error| ModelError::Toml(error.to_string()))?;
        Self::new(file)
    }

    /// Reads and checks a model file and the maps beside it.
    ///
    /// # Errors
    /// If a file cannot be read, or an entry is wrong.
    pub fn read(path: &Path) -> Result<Self, ModelError> {
        Self::new(ModelFile::read(path)?)
    }

    /// The same with a sensor that sees so many rows and columns beyond each cell of the path.
    ///
    /// # Errors
    /// If the radius is over 8.
    pub fn with_radius(self, radius: usize) -> Result<Self, ModelError> {
        let mut file = self.file;
        if radius == 0 && file.sensor.is_none() {
            return Self::new(file);
        }
        let sensor = file.sensor.get_or_insert_default();
        sensor.radius = radius;
        sensor.rings.truncate(radius);
        Self::new(file)
    }

    /// Checks a model file and lays out its arrays.
    ///
    /// # Errors
    /// If an entry is wrong; the error names it, what it must be and what it is.
    pub fn new(file: ModelFile) -> Result<Self, ModelError> {
        let check = Checker { model: &file.name };
        check.counts_and_names(&file)?;
        let kernels = check.kernels(&file)?;
        let bias = check.per_state(&file, "bias", |state| state.bias, 0.0)?;
        let reward = check.per_state(&file, "reward", |state| state.reward, f64::NEG_INFINITY)?;
        let initial = check.per_state(&file, "initial", |state| state.initial, 0.0)?;
        check.distribution("initial", initial.as_slice().unwrap_or_default())?;
        let likelihood = check.likelihood(&file)?;
        let initial = &initial / initial.sum();
        let zone_map = check.zone_map(&file)?.map(Arc::new);
        let no_fly = check.no_fly(&file)?.map(Arc::new);
        let edge = check.edge(&file)?;
        Ok(Self {
            edge,
            zone_map,
            no_fly,
            file,
            kernels,
            bias,
            likelihood,
            initial,
            reward,
        })
    }

    /// Checks that its maps are of a grid, and that eq. 3 never divides by zero or nearly zero there, whatever the
    /// states.
    ///
    /// # Errors
    /// If they are not, or it can; the error names the first such cell.
    pub fn check_on(&self, shape: Shape) -> Result<(), ModelError> {
        let maps = [
            ("zone_map", self.zone_map.as_ref().map(|map| map.dim())),
            ("no_fly", self.no_fly.as_ref().map(|map| map.dim())),
        ];
        for (what, dim) in maps {
            if let Some((height, width)) = dim.filter(|&dim| dim != shape.dim()) {
                return Err(ModelError::Value {
                    model: self.name().into(),
                    what: what.into(),
                    expected: format!("a map of the {shape} grid"),
                    got: format!("{height} x {width}"),
                });
            }
        }
        (0..self.kernels.len()).try_for_each(|kernel| self.check_kernel_on(kernel, shape))
    }

    fn check_kernel_on(&self, index: usize, shape: Shape) -> Result<(), ModelError> {
        let (kernel, own) = (&self.kernels[index], index % self.n_own());
        let column_sums = kernel.sum_axis(Axis(0));
        let mut least = column_sums.fold_axis(Axis(0), f64::INFINITY, |a, b| a.min(*b));
        let (kernel_height, kernel_width) = least.dim();
        if self.sees_own_state() {
            let (row, col) = (kernel_height / 2, kernel_width / 2);
            least[[row, col]] = column_sums[[own, row, col]];
        }
        // Of all zones: they are computed with one scale.
        let in_zones = self.kernels.iter().skip(own).step_by(self.n_own());
        let largest = in_zones
            .flatten()
            .chain(&self.bias)
            .copied()
            .fold(f64::MIN_POSITIVE, f64::max);
        // Cells further than a kernel from the edges are all alike: look at one of them.
        let distinct = |side: usize, kernel: usize| {
            (0..side).filter(move |&at| at <= kernel || at + kernel >= side)
        };
        for row in distinct(shape.height(), kernel_height) {
            for col in distinct(shape.width(), kernel_width) {
                let weights = least.indexed_iter().map(|((i, j), weight)| {
                    let (to_row, to_col) = (row + i, col + j);
                    let (up, left) = (kernel_height / 2, kernel_width / 2);
                    let is_on_grid = (up..shape.height() + up).contains(&to_row)
                        && (left..shape.width() + left).contains(&to_col);
                    match self.edge {
                        _ if is_on_grid => *weight,
                        Some(edge) => column_sums[[edge, i, j]],
                        None => 0.0,
                    }
                });
                let sum = self.bias.sum() + weights.sum::<f64>();
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

    /// Number of observations O: those that the file names, once for each observation matrix of the sensor.
    pub fn n_observations(&self) -> usize {
        self.likelihood.ncols()
    }

    /// Observation matrices of the sensor: of the path itself, then of each ring around it, up to the radius; the last
    /// holds for the rings beyond. Observation `y` by matrix `m` has the number `m * O / n_rings + y`.
    pub fn n_rings(&self) -> usize {
        1 + self
            .file
            .sensor
            .as_ref()
            .map_or(0, |sensor| sensor.rings.len())
    }

    /// Names of the observations: those of rings further out end in the ring.
    pub fn observation_names(&self) -> Vec<String> {
        let names = (0..self.n_rings()).flat_map(|ring| {
            self.file.observations.iter().map(move |it| match ring {
                0 => it.name.clone(),
                _ => format!("{} ring {ring}", it.name),
            })
        });
        names.collect()
    }

    /// Whether a cell's weights depend on the state that it is in itself.
    pub fn sees_own_state(&self) -> bool {
        self.n_own() > 1
    }

    /// Kernels of a zone: 1, or S if cells see their own state.
    fn n_own(&self) -> usize {
        self.kernels.len() / self.n_zones()
    }

    /// Number of zones, 1 where all cells are alike.
    pub fn n_zones(&self) -> usize {
        self.file.zones.len().max(1)
    }

    /// The zone of each cell, shape `[H, W]`, where cells differ.
    pub fn zone_map(&self) -> Option<&Arc<Grid<u8>>> {
        self.zone_map.as_ref()
    }

    /// Where robots of a grid may fly, and what they see from there.
    ///
    /// # Errors
    /// If maps are of another grid.
    pub fn airspace(&self, shape: Shape) -> Result<Airspace, ModelError> {
        self.check_on(shape)?;
        let sensor = self.file.sensor.clone().unwrap_or_default();
        Ok(Airspace::new(
            shape,
            self.no_fly.clone(),
            sensor.radius,
            self.n_rings(),
            sensor.pays,
        ))
    }

    /// Transition weights `w[to, from, row, col]`, shape `[S, S, KH, KW]`, all `>= 0` (eq. 2): one kernel
    /// for all cells, or one for each state that a cell itself can be in; as many for each zone, one zone after the
    /// other.
    pub fn kernels(&self) -> &[Array4<f64>] {
        &self.kernels
    }

    /// The first of [`Model::kernels`]: that of all cells, unless there are zones or [`Model::sees_own_state`].
    pub fn kernel(&self) -> &Array4<f64> {
        &self.kernels[0]
    }

    /// Transition bias `b[to]`, shape `[S]`, all `>= 0` (eq. 2).
    pub fn bias(&self) -> &Array1<f64> {
        &self.bias
    }

    /// The state that cells outside the grid are always in; `None`: they add no weight.
    pub fn edge(&self) -> Option<usize> {
        self.edge
    }

    /// `P(y | x)`, shape `[S, O]`; each row sums to one for each of the [`Model::n_rings`] matrices (eq. 1).
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

    /// Names of the states.
    pub fn state_names(&self) -> Vec<String> {
        let states = self.file.states.iter();
        states.map(|state| state.name.clone()).collect()
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

#[cfg(test)]
mod tests;
