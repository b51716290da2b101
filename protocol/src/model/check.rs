//! The checks that turn a [`ModelFile`] into arrays; the first that fails names its entry.

use super::file::{
    KernelEntry, MAX_KERNEL_SIDE, MAX_VALUES, ModelError, ModelFile, StateEntry, parse_color,
};
use ndarray::{Array1, Array2, Array3, Array4};
use std::ops::RangeInclusive;

/// Range of weights and biases that are not zero, and of the size of rewards: no sum or product of
/// those overflows or vanishes in `f64`.
const RANGE: RangeInclusive<f64> = 1e-100..=1e100;

/// Names that no state may have, as names of policies have them: `shooting_explore` beside `shooting_<state>`.
const RESERVED: [&str; 3] = ["exploit", "exploit_only", "explore"];

/// How far a probability distribution in a model file may be from summing to one.
const SUM_TOLERANCE: f64 = 1e-6;

/// The checks of [`super::Model::new`]; each returns what it checked.
pub(super) struct Checker<'a> {
    pub model: &'a str,
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

    pub fn counts_and_names(&self, file: &ModelFile) -> Result<(), ModelError> {
        let states: Vec<_> = file.states.iter().map(|s| (&s.name, &s.color)).collect();
        let observations: Vec<_> = file
            .observations
            .iter()
            .map(|o| (&o.name, &o.color))
            .collect();
        self.entries("state", "states", 2, &states)?;
        for state in &file.states {
            let (name, is_plain) = (&state.name, |c: char| {
                c.is_ascii_alphanumeric() || "-_".contains(c)
            });
            if name.is_empty() || !name.chars().all(is_plain) || RESERVED.contains(&name.as_str()) {
                let expected = format!("letters, digits, '-' and '_', and none of {RESERVED:?}");
                return self.wrong("state name".into(), &expected, format!("{name:?}"));
            }
        }
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

    pub fn per_state(
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

    pub fn distribution(&self, what: &str, values: &[f64]) -> Result<(), ModelError> {
        if values.iter().any(|v| !v.is_finite() || *v < 0.0) {
            return self.wrong(what.into(), "probabilities >= 0", format!("{values:?}"));
        }
        let sum: f64 = values.iter().sum();
        if (sum - 1.0).abs() > SUM_TOLERANCE {
            return self.wrong(what.into(), "a sum of 1", sum);
        }
        Ok(())
    }

    pub fn likelihood(&self, file: &ModelFile) -> Result<Array2<f64>, ModelError> {
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

    /// One kernel for all cells, or one for each state that a cell itself can be in.
    pub fn kernels(&self, file: &ModelFile) -> Result<Vec<Array4<f64>>, ModelError> {
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
        let n_kernels = self.n_kernels(file)?;
        let mut kernels = vec![Array4::zeros((n_states, n_states, height, width)); n_kernels];
        let mut filled = Array3::from_elem((n_kernels, n_states, n_states), false);
        for entry in &file.kernel {
            let own = match &entry.own {
                Some(own) => self.state(file, own)?,
                None => 0,
            };
            let (to, from) = (self.state(file, &entry.to)?, self.state(file, &entry.from)?);
            if std::mem::replace(&mut filled[[own, to, from]], true) {
                return self.wrong(entry.what(), "one entry for each pair of states", "two");
            }
            // The centre of a cell's kernel is the cell itself: weights of other states there have no effect.
            let is_void =
                |tap| entry.own.is_some() && own != from && tap == (height / 2, width / 2);
            for (row, col, weight) in self.weights(entry, file.kernel_size)? {
                if is_void((row, col)) {
                    continue;
                }
                kernels[own][[to, from, row, col]] = weight;
            }
        }
        Ok(kernels)
    }

    fn n_kernels(&self, file: &ModelFile) -> Result<usize, ModelError> {
        let names_own = |entry: &&KernelEntry| entry.own.is_some();
        let n_named = file.kernel.iter().filter(names_own).count();
        if n_named == 0 {
            return Ok(1);
        }
        if n_named < file.kernel.len() {
            let got = format!("{n_named} of {}", file.kernel.len());
            return self.wrong("kernel".into(), "own in every entry, or in none", got);
        }
        Ok(file.states.len())
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
