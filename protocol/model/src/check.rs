//! Checks a [`ModelFile`] and converts it to arrays. An error names the first wrong entry.

use super::cell_map::CellMap;
use super::file::{
    KernelEntry, MAX_KERNEL_SIDE, MAX_RADIUS, MAX_VALUES, MAX_ZONES, ModelError, ModelFile,
    StateEntry, parse_color,
};
use super::grid::Grid;
use crate::text::shortened;
use ndarray::{Array1, Array2, Array4};
use std::collections::HashSet;
use std::ops::RangeInclusive;

/// Allowed magnitudes of weights, biases and rewards that are not zero. Within this range, sums and products neither
/// overflow nor vanish in `f64`.
const RANGE: RangeInclusive<f64> = 1e-100..=1e100;

/// Maximum number of weights in all kernels together, 512 MiB. A model with 64 own-state kernels of 15 x 15 cells has
/// 59 million.
const MAX_WEIGHTS: usize = 1 << 26;

/// Reserved names, which no state may have. A policy's goal is either the name of a state or one of these words.
const RESERVED: [&str; 5] = ["coverage", "exploit", "exploit_only", "explore", "learned"];

/// Maximum difference between 1 and the sum of a distribution in a model file.
const SUM_TOLERANCE: f64 = 1e-6;

/// The checks of [`super::Model::new`]. Each returns the checked values.
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

    /// Checks the numbers of states, observations and zones, and their names and colours.
    pub fn counts_and_names(&self, file: &ModelFile) -> Result<(), ModelError> {
        let states: Vec<_> = file.states.iter().map(|s| (&s.name, &s.color)).collect();
        let observations: Vec<_> = file
            .observations
            .iter()
            .map(|o| (&o.name, &o.color))
            .collect();
        self.entries("state", "states", 2..=MAX_VALUES, &states)?;
        for state in &file.states {
            let (name, is_plain) = (&state.name, |c: char| {
                c.is_ascii_alphanumeric() || "-_".contains(c)
            });
            if name.is_empty() || !name.chars().all(is_plain) || RESERVED.contains(&name.as_str()) {
                let expected = format!("letters, digits, '-' and '_', and none of {RESERVED:?}");
                return self.wrong("state name".into(), &expected, format!("{name:?}"));
            }
        }
        self.entries("observation", "observations", 1..=MAX_VALUES, &observations)?;
        let zones: Vec<_> = file.zones.iter().map(|z| (&z.name, &z.color)).collect();
        self.entries("zone", "zones", 0..=MAX_ZONES, &zones)
    }

    fn entries(
        &self,
        what: &'static str,
        plural: &'static str,
        range: RangeInclusive<usize>,
        entries: &[(&String, &String)],
    ) -> Result<(), ModelError> {
        let got = entries.len();
        if !range.contains(&got) {
            return Err(ModelError::Count {
                model: self.model.into(),
                what: plural,
                least: *range.start(),
                most: *range.end(),
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

    /// Returns one number per state. Each must be finite and not below `least`.
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
            self.magnitude(what, got, got == 0.0)?;
        }
        Ok(file.states.iter().map(value).collect())
    }

    /// Checks that a number is 0, or that its magnitude is in [`RANGE`].
    fn magnitude(&self, what: String, got: f64, is_zero: bool) -> Result<(), ModelError> {
        if is_zero || RANGE.contains(&got.abs()) {
            return Ok(());
        }
        let (least, most) = (RANGE.start(), RANGE.end());
        let expected = format!("0, or a magnitude of {least:e} to {most:e}");
        self.wrong(what, &expected, format!("{got:e}"))
    }

    /// Checks that values are a probability distribution.
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

    /// Checks the radius of the sensor.
    pub fn radius(&self, file: &ModelFile) -> Result<(), ModelError> {
        match &file.sensor {
            Some(sensor) if sensor.radius > MAX_RADIUS => {
                let expected = format!("0 to {MAX_RADIUS} cells");
                self.wrong("sensor: radius".into(), &expected, sensor.radius)
            }
            _ => Ok(()),
        }
    }

    /// Returns the observation matrix, shape `[S, O]`.
    pub fn likelihood(&self, file: &ModelFile) -> Result<Array2<f64>, ModelError> {
        let mut likelihood = Array2::zeros((file.states.len(), file.observations.len()));
        for (entry, mut row) in file.states.iter().zip(likelihood.rows_mut()) {
            let what = format!("state {:?}: observed_as", entry.name);
            let values = &entry.observed_as;
            if values.len() != row.len() {
                let expected = format!("{} probabilities, one per observation", row.len());
                return self.wrong(what, &expected, values.len());
            }
            self.distribution(&what, values)?;
            let sum: f64 = values.iter().sum();
            row.iter_mut().zip(values).for_each(|(to, p)| *to = p / sum);
        }
        Ok(likelihood)
    }

    /// Returns the zone of each cell, if there are zones.
    pub fn zone_map(&self, file: &ModelFile) -> Result<Option<Grid<u8>>, ModelError> {
        let n_zones = file.zones.len();
        let Some(map) = &file.zone_map else {
            return match n_zones {
                0 => Ok(None),
                _ => self.wrong("zone_map".into(), "the zone of each cell", "none"),
            };
        };
        let map = self.map("zone_map", map)?;
        match map.iter().find(|&&zone| usize::from(zone) >= n_zones) {
            None => Ok(Some(map)),
            Some(got) => {
                let expected = format!("zones below {n_zones}, the number of `zones`");
                self.wrong("zone_map".into(), &expected, got)
            }
        }
    }

    /// Returns whether each cell is closed to robots, if the file has a no-fly map.
    pub fn no_fly(&self, file: &ModelFile) -> Result<Option<Grid<bool>>, ModelError> {
        let Some(map) = &file.no_fly else {
            return Ok(None);
        };
        let map = self.map("no_fly", map)?;
        if let Some(got) = map.iter().find(|&&flag| flag > 1) {
            return self.wrong("no_fly".into(), "0 or 1 for each cell", got);
        }
        if map.iter().all(|&flag| flag == 1) {
            return self.wrong("no_fly".into(), "a cell where robots may be", "none");
        }
        Ok(Some(map.mapv(|flag| flag == 1)))
    }

    fn map(&self, what: &str, map: &CellMap) -> Result<Grid<u8>, ModelError> {
        map.grid()
            .or_else(|(expected, got)| self.wrong(what.into(), &expected, got))
    }

    /// Returns the kernels, zone by zone. Each zone has one kernel, or one for each own state (the state of the cell
    /// itself).
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
        let (n_zones, n_own) = (file.zones.len().max(1), self.n_own(file)?);
        self.check_zones(file)?;
        let n_weights = n_zones * n_own * n_states * n_states * height * width;
        if n_weights > MAX_WEIGHTS {
            let expected = format!("at most {MAX_WEIGHTS} weights in all zones");
            return self.wrong("kernel".into(), &expected, n_weights);
        }
        let mut kernels = vec![Array4::zeros((n_states, n_states, height, width)); n_zones * n_own];
        let mut filled = HashSet::new();
        for entry in &file.kernel {
            let own = match &entry.own {
                Some(own) => self.state(file, own)?,
                None => 0,
            };
            let named = |name: &String| file.zones.iter().position(|zone| zone.name == *name);
            let zone = entry.zone.as_ref().and_then(named).unwrap_or(0);
            let (to, from) = (self.state(file, &entry.to)?, self.state(file, &entry.from)?);
            if !filled.insert((zone, own, to, from)) {
                return self.wrong(entry.what(), "one entry for each pair of states", "two");
            }
            // The neighbour at the centre of the kernel is the cell itself, whose state is `own`. So the centre weights
            // of other states have no effect.
            let is_void =
                |tap| entry.own.is_some() && own != from && tap == (height / 2, width / 2);
            for (row, col, weight) in self.weights(entry, file.kernel_size)? {
                if is_void((row, col)) {
                    continue;
                }
                kernels[zone * n_own + own][[to, from, row, col]] = weight;
            }
        }
        Ok(kernels)
    }

    /// If there are zones, checks that each kernel entry names a zone and that each zone has an entry.
    fn check_zones(&self, file: &ModelFile) -> Result<(), ModelError> {
        let names: HashSet<&str> = file.zones.iter().map(|zone| zone.name.as_str()).collect();
        let mut with_kernel = HashSet::new();
        for entry in &file.kernel {
            let zone = entry.zone.as_deref();
            let fits = zone.map_or(names.is_empty(), |zone| names.contains(zone));
            if !fits {
                let expected = if names.is_empty() {
                    "no zone, because the model has no `zones`"
                } else {
                    "the name of one of `zones`"
                };
                let got = zone.map_or("none".into(), |zone| format!("{zone:?}"));
                return self.wrong(format!("{}: zone", entry.what()), expected, got);
            }
            with_kernel.extend(zone);
        }
        match file
            .zones
            .iter()
            .find(|zone| !with_kernel.contains(&*zone.name))
        {
            None => Ok(()),
            Some(zone) => {
                let what = format!("zone {:?}", zone.name);
                self.wrong(what, "kernel entries with its name", "none")
            }
        }
    }

    fn n_own(&self, file: &ModelFile) -> Result<usize, ModelError> {
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
                self.magnitude(entry.what(), weight, *value == 0.0 || entry.scale == 0.0)?;
                weights.push((row, col, weight));
            }
        }
        Ok(weights)
    }

    /// Returns the state of the cells outside the grid, if the file names one.
    pub fn edge(&self, file: &ModelFile) -> Result<Option<usize>, ModelError> {
        let Some(name) = &file.edge else {
            return Ok(None);
        };
        let names: Vec<&str> = file.states.iter().map(|it| it.name.as_str()).collect();
        let state = names.iter().position(|known| known == name);
        if state.is_none() {
            let expected = format!(
                "the name of a state, one of {}",
                shortened(&format!("{names:?}"))
            );
            return self.wrong("edge".into(), &expected, format!("{name:?}"));
        }
        Ok(state)
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
