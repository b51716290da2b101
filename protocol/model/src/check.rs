//! Checks a [`ModelFile`] and converts it to arrays. An error names the first wrong entry.

use super::file::{
    KernelEntry, MAX_KERNEL_SIDE, MAX_RADIUS, MAX_VALUES, MIN_PROBABILITY, ModelError, ModelFile,
    StateEntry, TransitionEntry, parse_color,
};
use super::grid::{Grid, Shape};
use super::hazards::{Factors, Hazards, Near, Transition, hazard};
use super::maps::Maps;
use crate::text::shortened;
use ndarray::{Array1, Array2, Array4};
use std::collections::HashSet;
use std::ops::RangeInclusive;

/// Allowed magnitudes of weights, biases and rewards that are not zero. Within this range, sums and products neither
/// overflow nor vanish in `f64`.
const RANGE: RangeInclusive<f64> = 1e-100..=1e100;

const MAX_FACTOR: f32 = 1e6;

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
        self.entries("observation", "observations", 1..=MAX_VALUES, &observations)
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

    fn magnitude(&self, what: String, got: f64, is_zero: bool) -> Result<(), ModelError> {
        if is_zero || RANGE.contains(&got.abs()) {
            return Ok(());
        }
        let (least, most) = (RANGE.start(), RANGE.end());
        let expected = format!("0, or a magnitude of {least:e} to {most:e}");
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

    /// Returns whether each cell is closed to robots, if the file has a no-fly map.
    pub fn no_fly(&self, file: &ModelFile) -> Result<Option<Grid<bool>>, ModelError> {
        let Some(map) = &file.no_fly else {
            return Ok(None);
        };
        let map = map
            .grid()
            .or_else(|(expected, got)| self.wrong("no_fly".into(), &expected, got))?;
        if let Some(got) = map.iter().find(|&&flag| flag > 1) {
            return self.wrong("no_fly".into(), "0 or 1 for each cell", got);
        }
        if map.iter().all(|&flag| flag == 1) {
            return self.wrong("no_fly".into(), "a cell where robots may be", "none");
        }
        Ok(Some(map.mapv(|flag| flag == 1)))
    }

    /// Checks that a file has entries of one kind, and returns whether it is a model of hazards.
    pub fn is_of_hazards(&self, file: &ModelFile) -> Result<bool, ModelError> {
        let (has_kernel, has_transitions) = (!file.kernel.is_empty(), !file.transitions.is_empty());
        if has_kernel == has_transitions {
            let what = "kernel and transitions".into();
            let got = if has_kernel { "both" } else { "none" };
            return self.wrong(what, "entries of exactly one of them", got);
        }
        if !has_transitions {
            return match &file.maps {
                Some(_) => self.wrong(
                    "maps".into(),
                    "none, because no transition uses them",
                    "maps",
                ),
                None => Ok(false),
            };
        }
        if let Some([height, width]) = file.kernel_size {
            let expected = "none, because `near` has the size";
            return self.wrong(
                "kernel_size".into(),
                expected,
                format!("[{height}, {width}]"),
            );
        }
        match file.states.iter().find(|state| state.bias != 0.0) {
            Some(state) => {
                let what = format!("state {:?}: bias", state.name);
                self.wrong(what, "none, because transitions have `base`", state.bias)
            }
            None => Ok(true),
        }
    }

    /// Returns the kernel of eq. 2, shape `[S, S, KH, KW]`.
    pub fn kernel(&self, file: &ModelFile) -> Result<Array4<f64>, ModelError> {
        let Some(size) = file.kernel_size else {
            return self.wrong("kernel_size".into(), "the size of `weights`", "none");
        };
        self.is_odd("kernel_size".into(), size)?;
        let [height, width] = size;
        let n_states = file.states.len();
        let mut kernel = Array4::zeros((n_states, n_states, height, width));
        let mut filled = HashSet::new();
        for entry in &file.kernel {
            let state = |name: &str| self.state(file, entry.what(), name);
            let (to, from) = (state(&entry.to)?, state(&entry.from)?);
            if !filled.insert((to, from)) {
                return self.wrong(entry.what(), "one entry for each pair of states", "two");
            }
            for (row, col, weight) in self.weights(entry, size)? {
                kernel[[to, from, row, col]] = weight;
            }
        }
        Ok(kernel)
    }

    fn is_odd(&self, what: String, size: [usize; 2]) -> Result<(), ModelError> {
        if size
            .iter()
            .all(|side| side % 2 == 1 && *side <= MAX_KERNEL_SIDE)
        {
            return Ok(());
        }
        let expected = format!("two odd numbers up to {MAX_KERNEL_SIDE}");
        self.wrong(what, &expected, format!("{size:?}"))
    }

    pub fn hazards(&self, file: &ModelFile) -> Result<Hazards, ModelError> {
        let maps = file.maps.as_ref().map_or(Ok(Maps::new()), |entry| {
            let unpacked = entry.unpack();
            unpacked.or_else(|(expected, got)| self.wrong("maps".into(), &expected, got))
        })?;
        let shape = self.shape_of(&maps)?;
        let mut transitions = vec![Vec::new(); file.states.len()];
        let (mut size, mut used) = ([1, 1], HashSet::new());
        for entry in &file.transitions {
            let state = |name: &str| self.state(file, entry.what(), name);
            let (from, to) = (state(&entry.from)?, state(&entry.to)?);
            if from == to {
                return self.wrong(entry.what(), "another state", format!("{:?}", entry.to));
            }
            self.probability(entry, "base", entry.base)?;
            let mut near = Vec::new();
            for (state, table) in &entry.near {
                let (of_table, neighbours) = self.near(file, entry, state, table)?;
                size = [size[0].max(of_table[0]), size[1].max(of_table[1])];
                near.extend(neighbours);
            }
            used.extend(entry.times.iter().map(String::as_str));
            transitions[from].push(Transition {
                to,
                base: hazard(entry.base),
                near,
                factors: self.factors(entry, &maps)?,
            });
        }
        if let Some(unused) = maps.keys().find(|name| !used.contains(name.as_str())) {
            let what = format!("maps: {unused:?}");
            return self.wrong(what, "a transition that names it in `times`", "none");
        }
        Ok(Hazards {
            size,
            transitions,
            maps,
            shape,
        })
    }

    fn shape_of(&self, maps: &Maps) -> Result<Option<Shape>, ModelError> {
        let mut shape = None;
        for (name, map) in maps {
            let what = || format!("maps: {name:?}");
            let of_map = match map.shape() {
                &[height, width] | &[_, _, height, width] => Shape::new(height, width).ok(),
                _ => None,
            };
            if of_map.is_none() || (shape.is_some() && shape != of_map) {
                let expected =
                    "shape [H, W] or [KH, KW, H, W], with the same grid H x W in all maps";
                return self.wrong(what(), expected, format!("{:?}", map.shape()));
            }
            if let Some(got) = map
                .iter()
                .find(|factor| !(0.0..=MAX_FACTOR).contains(*factor))
            {
                let expected = format!("factors from 0 to {MAX_FACTOR}");
                return self.wrong(what(), &expected, got);
            }
            shape = of_map;
        }
        Ok(shape)
    }

    fn factors(&self, entry: &TransitionEntry, maps: &Maps) -> Result<Factors, ModelError> {
        let mut factors = Factors::default();
        for name in &entry.times {
            let Some(map) = maps.get(name) else {
                let names: Vec<&String> = maps.keys().collect();
                let expected = format!("one of the maps {}", shortened(&format!("{names:?}")));
                return self.wrong(
                    format!("{}: times", entry.what()),
                    &expected,
                    format!("{name:?}"),
                );
            };
            let size = [map.shape()[0], map.shape()[1]];
            let is_of_size = |table: &Vec<Vec<f64>>| [table.len(), table[0].len()] == size;
            if map.ndim() == 4 && !entry.near.values().all(is_of_size) {
                let expected = format!(
                    "tables `near` of {} x {} cells, as in map {name:?}",
                    size[0], size[1]
                );
                return self.wrong(entry.what(), &expected, "another size");
            }
            factors.multiply(map);
        }
        Ok(factors)
    }

    fn probability(&self, entry: &TransitionEntry, what: &str, got: f64) -> Result<(), ModelError> {
        if got == 0.0 || (MIN_PROBABILITY..=1.0).contains(&got) {
            return Ok(());
        }
        let expected = format!("a probability: 0, or {MIN_PROBABILITY:e} to 1");
        self.wrong(format!("{}: {what}", entry.what()), &expected, got)
    }

    /// Returns the size of a table, and its neighbours with a hazard.
    fn near(
        &self,
        file: &ModelFile,
        entry: &TransitionEntry,
        name: &str,
        table: &[Vec<f64>],
    ) -> Result<([usize; 2], Vec<Near>), ModelError> {
        let part = format!("near.{name}");
        let what = || format!("{}: {part}", entry.what());
        let state = self.state(file, what(), name)?;
        let size = [table.len(), table.first().map_or(0, Vec::len)];
        self.is_odd(what(), size)?;
        if let Some(got) = table.iter().map(Vec::len).find(|&length| length != size[1]) {
            return self.wrong(what(), &format!("rows of {} probabilities", size[1]), got);
        }
        let [up, left] = size.map(|side| side / 2);
        if table[up][left] != 0.0 {
            let expected = "0 at the centre, because no cell is its own neighbour: use `base`";
            return self.wrong(what(), expected, table[up][left]);
        }
        let mut near = Vec::new();
        for (row, values) in table.iter().enumerate() {
            for (col, &probability) in values.iter().enumerate() {
                self.probability(entry, &part, probability)?;
                let offset = [row as isize - up as isize, col as isize - left as isize];
                if probability > 0.0 {
                    near.push(Near {
                        state,
                        offset,
                        hazard: hazard(probability),
                    });
                }
            }
        }
        Ok((size, near))
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

    pub fn edge(&self, file: &ModelFile) -> Result<Option<usize>, ModelError> {
        let name = file.edge.as_deref();
        name.map(|name| self.state(file, "edge".into(), name))
            .transpose()
    }

    fn state(&self, file: &ModelFile, what: String, name: &str) -> Result<usize, ModelError> {
        let names: Vec<&str> = file.states.iter().map(|it| it.name.as_str()).collect();
        let found = names.iter().position(|&known| known == name);
        let Some(state) = found else {
            let known = format!("{names:?}");
            let expected = format!("the name of a state, one of {}", shortened(&known));
            return self.wrong(what, &expected, format!("{name:?}"));
        };
        Ok(state)
    }
}
