//! The parameters of the hidden Markov model on a grid, for simulators and filters.
//!
//! Paper section II: states with the transition kernel `w` and bias `b` (eq. 2), and the observation matrix `O` (eq. 1).
//! [`super::file`] is the file format. [`super::transition`] applies the parameters to beliefs, and [`super::dynamics`]
//! applies them to states.

use super::airspace::Airspace;
use super::built_in::MODELS;
use super::check::Checker;
use super::file::{LEAST_SHARE, ModelError, ModelFile, SensorEntry};
use super::grid::{Cell, Grid, Shape};
use super::hazards::Hazards;
use ndarray::{Array1, Array2, Array4, ArrayView1, Axis};
use std::path::Path;
use std::sync::Arc;

/// How the next state of a cell depends on its neighbourhood.
#[derive(Debug, Clone, PartialEq)]
pub enum Rule {
    /// The paper's rule (eqs. 2 and 3): weights of the neighbours, divided by their sum.
    Ratio(Ratio),
    /// Each neighbour causes transitions independently of the others.
    Hazards(Arc<Hazards>),
}

/// The parameters of eq. 2.
#[derive(Debug, Clone, PartialEq)]
pub struct Ratio {
    kernel: Array4<f64>,
    bias: Array1<f64>,
}

/// A place of a kernel where the weights of two states differ by more than a factor of 2.
#[derive(Debug, Clone, PartialEq)]
pub struct UnevenPlace {
    pub place: [usize; 2],
    /// The states with the smallest and the largest weight, summed over the next states.
    pub states: [usize; 2],
    pub weights: [f64; 2],
}

/// A checked model. Every value of this type is valid for simulation and filtering.
#[derive(Debug, Clone, PartialEq)]
pub struct Model {
    file: ModelFile,
    rule: Rule,
    likelihood: Array2<f64>,
    initial: Array1<f64>,
    reward: Array1<f64>,
    edge: Option<usize>,
    /// For each cell, whether it is closed to robots.
    no_fly: Option<Arc<Grid<bool>>>,
}

impl Model {
    /// Returns the built-in wildfire model (`config/models/wildfire.toml`).
    pub fn wildfire() -> Self {
        Self::built_in("wildfire").expect("invariant: the wildfire is built in")
    }

    /// Finds a built-in model by its name (`config/models`).
    pub fn built_in(name: &str) -> Option<Self> {
        let (_, text) = MODELS.iter().find(|(known, _)| *known == name)?;
        let model = Self::from_toml(text);
        Some(model.expect("invariant: built-in models are valid, as a test shows"))
    }

    pub fn built_in_names() -> impl Iterator<Item = &'static str> {
        Self::built_in_files().map(|(name, _)| name)
    }

    /// Lists the built-in models, each as its name and the text of its file.
    pub fn built_in_files() -> impl Iterator<Item = (&'static str, &'static str)> {
        MODELS.iter().copied()
    }

    /// Reads and checks a model file's text.
    ///
    /// # Errors
    /// If an entry is wrong. The error names the entry, the expected value and the given value.
    pub fn from_toml(text: &str) -> Result<Self, ModelError> {
        Self::new(toml::from_str(text)?)
    }

    /// Reads and checks a model file, and the map files in its folder.
    ///
    /// # Errors
    /// If a file cannot be read, or an entry is wrong.
    pub fn read(path: &Path) -> Result<Self, ModelError> {
        Self::new(ModelFile::read(path)?)
    }

    /// Replaces the radius of the sensor: the number of rows and columns that it sees around each cell of the path.
    ///
    /// # Errors
    /// If the radius is over 8.
    pub fn with_radius(self, radius: usize) -> Result<Self, ModelError> {
        let sensor = (radius > 0).then_some(SensorEntry { radius });
        Self::new(ModelFile {
            sensor,
            ..self.file
        })
    }

    /// Checks a model file and lays out its arrays.
    ///
    /// # Errors
    /// If an entry is wrong. The error names the entry, the expected value and the given value.
    pub fn new(file: ModelFile) -> Result<Self, ModelError> {
        let check = Checker { model: &file.name };
        check.counts_and_names(&file)?;
        let bias = check.per_state(&file, "bias", |state| state.bias, 0.0)?;
        let rule = if check.is_of_hazards(&file)? {
            Rule::Hazards(Arc::new(check.hazards(&file)?))
        } else {
            let kernel = check.kernel(&file)?;
            Rule::Ratio(Ratio { kernel, bias })
        };
        let reward = check.per_state(&file, "reward", |state| state.reward, f64::NEG_INFINITY)?;
        let initial = check.per_state(&file, "initial", |state| state.initial, 0.0)?;
        check.distribution("initial", initial.as_slice().unwrap_or_default())?;
        check.radius(&file)?;
        let likelihood = check.likelihood(&file)?;
        let initial = &initial / initial.sum();
        let no_fly = check.no_fly(&file)?.map(Arc::new);
        let edge = check.edge(&file)?;
        Ok(Self {
            edge,
            no_fly,
            file,
            rule,
            likelihood,
            initial,
            reward,
        })
    }

    /// Checks that the model's maps fit a grid, and that eq. 3 cannot divide by zero or nearly zero there.
    ///
    /// # Errors
    /// If a map does not fit the grid, or if the weights of a cell can sum to nearly zero. The error names the first
    /// such cell.
    pub fn check_on(&self, shape: Shape) -> Result<(), ModelError> {
        let no_fly = self.no_fly.as_ref().map(|map| map.dim());
        let maps = self.hazards().and_then(Hazards::shape).map(Shape::dim);
        for (what, dim) in [("maps", maps), ("no_fly", no_fly)] {
            if let Some((height, width)) = dim.filter(|&dim| dim != shape.dim()) {
                return Err(ModelError::Value {
                    model: self.name().into(),
                    what: what.into(),
                    expected: format!("a map of the {shape} grid"),
                    got: format!("{height} x {width}"),
                });
            }
        }
        match &self.rule {
            Rule::Ratio(ratio) => self.check_ratio_on(ratio, shape),
            Rule::Hazards(_) => Ok(()),
        }
    }

    fn check_ratio_on(&self, ratio: &Ratio, shape: Shape) -> Result<(), ModelError> {
        let Ratio { kernel, bias } = ratio;
        let column_sums = kernel.sum_axis(Axis(0));
        let least = column_sums.fold_axis(Axis(0), f64::INFINITY, |a, b| a.min(*b));
        let (kernel_height, kernel_width) = least.dim();
        let numbers = kernel.iter().chain(bias);
        let largest = numbers.copied().fold(f64::MIN_POSITIVE, f64::max);
        // All cells further than a kernel from the edges have the same weights, so checking one such row and column is
        // enough.
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
                let sum = bias.sum() + weights.sum::<f64>();
                self.check_share(sum / largest, shape, Cell { row, col })?;
            }
        }
        Ok(())
    }

    /// Checks the smallest possible sum of a cell's weights, relative to the largest weight.
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

    pub fn name(&self) -> &str {
        &self.file.name
    }

    pub fn file(&self) -> &ModelFile {
        &self.file
    }

    pub fn n_states(&self) -> usize {
        self.file.states.len()
    }

    pub fn n_observations(&self) -> usize {
        self.file.observations.len()
    }

    pub fn observation_names(&self) -> Vec<String> {
        let observations = self.file.observations.iter();
        observations.map(|it| it.name.clone()).collect()
    }

    pub fn rule(&self) -> &Rule {
        &self.rule
    }

    /// Returns the parameters of eq. 2, or `None` if this is a model of hazards.
    pub fn ratio(&self) -> Option<&Ratio> {
        match &self.rule {
            Rule::Ratio(ratio) => Some(ratio),
            Rule::Hazards(_) => None,
        }
    }

    /// Returns the transitions, or `None` if the model has the paper's rule.
    pub fn hazards(&self) -> Option<&Hazards> {
        match &self.rule {
            Rule::Ratio(_) => None,
            Rule::Hazards(hazards) => Some(hazards),
        }
    }

    /// Returns the number of rows and columns of the neighbourhood that influences a cell, both odd.
    pub fn kernel_size(&self) -> [usize; 2] {
        match &self.rule {
            Rule::Ratio(ratio) => {
                let (_, _, height, width) = ratio.kernel.dim();
                [height, width]
            }
            Rule::Hazards(hazards) => hazards.size(),
        }
    }

    /// Returns the cells where robots may fly, and the cells that they see from there.
    ///
    /// # Errors
    /// If a map does not fit the grid.
    pub fn airspace(&self, shape: Shape) -> Result<Airspace, ModelError> {
        self.check_on(shape)?;
        Ok(Airspace::new(shape, self.no_fly.clone(), self.radius()))
    }

    pub fn radius(&self) -> usize {
        self.file.sensor.as_ref().map_or(0, |sensor| sensor.radius)
    }

    /// Returns the state of all cells outside the grid. If it is `None`, these cells influence no
    /// other cell.
    pub fn edge(&self) -> Option<usize> {
        self.edge
    }

    /// Returns `P(y | x)`, shape `[S, O]`. Each row sums to one (eq. 1).
    pub fn likelihood(&self) -> &Array2<f64> {
        &self.likelihood
    }

    /// Returns the distribution of each cell's state at the start of burn-in, shape `[S]`.
    pub fn initial(&self) -> &Array1<f64> {
        &self.initial
    }

    /// Returns the reward of each state per distinct visited cell, shape `[S]`.
    pub fn reward(&self) -> &Array1<f64> {
        &self.reward
    }

    pub fn state_names(&self) -> Vec<String> {
        let states = self.file.states.iter();
        states.map(|state| state.name.clone()).collect()
    }

    /// Returns the state with the highest reward, or the first of several such states. In the wildfire model it is
    /// fire.
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

    pub fn state_named(&self, name: &str) -> Option<usize> {
        self.file.states.iter().position(|state| state.name == name)
    }
}

impl Ratio {
    /// Returns the kernel `w[to, from, row, col]`, shape `[S, S, KH, KW]`. All weights are `>= 0` (eq. 2).
    pub fn kernel(&self) -> &Array4<f64> {
        &self.kernel
    }

    /// Returns the transition biases `b[to]`, shape `[S]`. All are `>= 0` (eq. 2).
    pub fn bias(&self) -> &Array1<f64> {
        &self.bias
    }

    /// Returns the first place of the kernel where the weights of two states differ by more than a factor of 2.
    ///
    /// The filter of such a model predicts badly, because it adds the weights of all states before it divides.
    pub fn uneven_place(&self) -> Option<UnevenPlace> {
        let sums = self.kernel.sum_axis(Axis(0));
        let uneven = |([row, col], weights): ([usize; 2], ArrayView1<f64>)| {
            let order = |a: &usize, b: &usize| weights[*a].total_cmp(&weights[*b]);
            let states = 0..weights.len();
            let states = [states.clone().min_by(order)?, states.max_by(order)?];
            let weights = states.map(|state| weights[state]);
            (weights[1] > 2.0 * weights[0]).then_some(UnevenPlace {
                place: [row, col],
                states,
                weights,
            })
        };
        let (_, height, width) = sums.dim();
        let places = (0..height).flat_map(|row| (0..width).map(move |col| [row, col]));
        let mut places = places.zip(sums.lanes(Axis(0)));
        places.find_map(uneven)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the uneven place of the wildfire whose fire has `scale` times its weight.
    fn scaled(scale: f64) -> Option<([usize; 2], usize)> {
        let mut file = Model::wildfire().file().clone();
        for entry in file.kernel.iter_mut().filter(|entry| entry.from == "fire") {
            entry.scale *= scale;
        }
        let model = Model::new(file).expect("a model");
        let uneven = model.ratio().and_then(Ratio::uneven_place)?;
        assert!(uneven.weights[1] > 2.0 * uneven.weights[0]);
        let fire = uneven.states.iter().position(|&state| state == 2);
        Some((uneven.place, fire.expect("fire")))
    }

    #[test]
    fn places_are_uneven_above_a_factor_of_two() {
        for name in Model::built_in_names() {
            let model = Model::built_in(name).expect("built in");
            assert_eq!(model.ratio().and_then(Ratio::uneven_place), None, "{name}");
        }
        // Fire has weight .12 in the first row, .1 in the second and .08 in the third, and the other states have .1.
        assert_eq!(scaled(1.6), None);
        assert_eq!(scaled(1.7), Some(([0, 0], 1)));
        assert_eq!(scaled(0.6), Some(([2, 0], 0)));
    }
}
