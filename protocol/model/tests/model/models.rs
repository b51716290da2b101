//! Models other than the wildfire model, random states and beliefs, and the formula that all models follow.

use emberwatch_model::randomness::split_mix;
use emberwatch_model::{CellMap, Grid, KernelEntry, Model, ModelFile, Shape, ZoneEntry};
use ndarray::{Array3, Axis};

/// Makes a model with weights `weight(to, from, row, col)` and biases `bias(to)`.
pub fn model(
    n_states: usize,
    kernel_size: [usize; 2],
    weight: impl Fn(usize, usize, usize, usize) -> f64,
    bias: impl Fn(usize) -> f64,
) -> Model {
    let name = |state: usize| format!("s{state}");
    let template = Model::wildfire().file().clone();
    let mut file = ModelFile {
        name: "test".into(),
        kernel_size,
        states: vec![template.states[0].clone(); n_states],
        kernel: Vec::new(),
        ..template
    };
    for (state, entry) in file.states.iter_mut().enumerate() {
        entry.name = name(state);
        entry.initial = 1.0 / n_states as f64;
        entry.bias = bias(state);
    }
    let [height, width] = kernel_size;
    for (to, from) in ndarray::indices((n_states, n_states)) {
        let row = |row| (0..width).map(|col| weight(to, from, row, col)).collect();
        file.kernel.push(KernelEntry {
            zone: None,
            own: None,
            from: name(from),
            to: name(to),
            scale: 1.0,
            weights: (0..height).map(row).collect(),
        });
    }
    checked(file)
}

pub fn checked(file: ModelFile) -> Model {
    Model::new(file).expect("test models are valid")
}

/// Adds an edge state, chosen by `key`, to a model.
pub fn with_edge(model: &Model, key: u64) -> Model {
    let mut file = model.file().clone();
    file.edge = Some(file.states[key as usize % model.n_states()].name.clone());
    checked(file)
}

/// Makes a model with random weights, a third of them zero, and random biases.
pub fn random_model(key: u64, n_states: usize, [height, width]: [usize; 2]) -> Model {
    let weight = |to, from, row, col| {
        let index = ((to * n_states + from) * height + row) * width + col;
        let is_zero = split_mix(key, index as u64).is_multiple_of(3);
        if is_zero { 0.0 } else { unit(key + 1, index) }
    };
    model(n_states, [height, width], weight, |to| unit(key + 2, to))
}

/// Makes a random model with one kernel per own state. In some kernels neighbours have no weight.
pub fn random_own_model(key: u64, n_states: usize, kernel_size: [usize; 2]) -> Model {
    let mut file = random_model(key, n_states, kernel_size).file().clone();
    file.kernel.clear();
    let [row, col] = kernel_size.map(|side| side / 2);
    for own in 0..n_states {
        let of_all = random_model(key + 10 * own as u64, n_states, kernel_size);
        let ignores_neighbours = own > 0 && split_mix(key, own as u64).is_multiple_of(2);
        for mut entry in of_all.file().kernel.clone() {
            let centre = entry.weights[row][col];
            if ignores_neighbours {
                entry.weights.iter_mut().for_each(|row| row.fill(0.0));
            }
            entry.own = Some(format!("s{own}"));
            // Weights of other states at the centre have no effect.
            let is_void = entry.own.as_ref() != Some(&entry.from);
            entry.weights[row][col] = if is_void { 1e60 } else { centre };
            file.kernel.push(entry);
        }
    }
    checked(file)
}

/// Makes a model with zones scattered over a grid. Each zone has the kernels of another model.
pub fn zoned(models: &[Model], key: u64, (height, width): (usize, usize)) -> Model {
    let mut file = models[0].file().clone();
    let (name, n_zones) = (|zone: usize| format!("z{zone}"), models.len());
    let zone = |zone| ZoneEntry {
        name: name(zone),
        color: "#808080".into(),
    };
    file.zones = (0..n_zones).map(zone).collect();
    let draw = |(row, col): (usize, usize)| split_mix(key, (row * width + col / 3) as u64) >> 9;
    let map = Grid::from_shape_fn((height, width), |at| (draw(at) % n_zones as u64) as u8);
    let rows = map.outer_iter().map(|row| row.to_vec());
    file.zone_map = Some(CellMap::Rows(rows.collect()));
    file.kernel.clear();
    for (zone, model) in models.iter().enumerate() {
        let entries = model.file().kernel.iter().cloned();
        file.kernel.extend(entries.map(|entry| KernelEntry {
            zone: Some(name(zone)),
            ..entry
        }));
    }
    checked(file)
}

/// Makes a zoned model from random models. Some weights are the same in all zones.
pub fn random_land(key: u64, models: &[Model], side: (usize, usize)) -> Model {
    let mut file = zoned(models, key, side).file().clone();
    let n_entries = models[0].file().kernel.len();
    for at in (0..file.kernel.len()).filter(|at| (at % n_entries).is_multiple_of(3)) {
        file.kernel[at].weights = file.kernel[at % n_entries].weights.clone();
    }
    checked(file)
}

/// Computes each state's probability in each cell after a step (paper eqs. 2 to 4), directly from the entries of the
/// model file, as explained in docs/model-file.md.
pub fn formula(model: &Model, p: &Array3<f64>) -> Array3<f64> {
    let file = model.file();
    let (n_states, height, width) = p.dim();
    let state = |name: &String| model.state_named(name).expect("a state");
    let ends = |entry: &KernelEntry| {
        let own = entry.own.as_ref().map(state);
        (own, state(&entry.from), state(&entry.to))
    };
    let entries: Vec<_> = file.kernel.iter().map(|it| (it, ends(it))).collect();
    let owns: Vec<Option<usize>> = match entries[0].1.0 {
        Some(_) => (0..n_states).map(Some).collect(),
        None => vec![None],
    };
    let [up, left] = file.kernel_size.map(|side| side / 2);
    let mut next = Array3::zeros(p.dim());
    for (row, col) in ndarray::indices((height, width)) {
        let zones = model.zone_map();
        let zone = zones.map(|map| &file.zones[usize::from(map[[row, col]])].name);
        for &own in &owns {
            let mut weights: Vec<f64> = file.states.iter().map(|state| state.bias).collect();
            let here = |entry: &&KernelEntry| entry.zone.as_ref() == zone;
            for (entry, (of, from, to)) in &entries {
                if *of != own || !here(entry) {
                    continue;
                }
                for (a, c) in ndarray::indices((file.kernel_size[0], file.kernel_size[1])) {
                    let (i, j) = ((row + a).wrapping_sub(up), (col + c).wrapping_sub(left));
                    let beyond = f64::from(file.edge.as_ref() == Some(&entry.from));
                    let x = match own {
                        Some(own) if (a, c) == (up, left) => f64::from(own == *from),
                        _ => p.get([*from, i, j]).copied().unwrap_or(beyond),
                    };
                    weights[*to] += entry.scale * entry.weights[a][c] * x;
                }
            }
            let share = own.map_or(1.0, |own| p[[own, row, col]]) / weights.iter().sum::<f64>();
            for (to, weight) in weights.iter().enumerate() {
                next[[to, row, col]] += share * weight;
            }
        }
    }
    next
}

/// Returns a random number in `[0, 1)`.
pub fn unit(key: u64, index: usize) -> f64 {
    (split_mix(key, index as u64) >> 11) as f64 / 2f64.powi(53)
}

pub fn shape(height: usize, width: usize) -> Shape {
    Shape::new(height, width).expect("test shape")
}

pub fn random_states(key: u64, n_states: usize, (height, width): (usize, usize)) -> Grid<u8> {
    Grid::from_shape_fn((height, width), |(row, col)| {
        (unit(key, row * width + col) * n_states as f64) as u8
    })
}

/// Makes a random belief. The probabilities of each cell sum to one.
pub fn random_belief(key: u64, n_states: usize, (height, width): (usize, usize)) -> Array3<f64> {
    let mut belief = Array3::from_shape_fn((n_states, height, width), |(state, row, col)| {
        unit(key, (state * height + row) * width + col)
    });
    let sums = belief.sum_axis(Axis(0));
    belief /= &sums;
    belief
}
