//! Models other than the wildfire model, random states and beliefs, and the formula that all models follow.

use emberwatch_model::randomness::split_mix;
use emberwatch_model::{Grid, KernelEntry, MapsEntry, Model, ModelFile, Shape, TransitionEntry};
use ndarray::{Array3, ArrayD, Axis};
use std::collections::BTreeMap;

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
        kernel_size: Some(kernel_size),
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

/// Makes a random model of hazards. Some transitions are certain, some have no neighbours, and with a side of maps, some
/// have factors.
pub fn random_hazards(
    key: u64,
    n_states: usize,
    [height, width]: [usize; 2],
    maps: Option<(usize, usize)>,
) -> Model {
    let template = random_model(key, n_states, [1, 1]).file().clone();
    let mut numbers = (0..).map(|index| unit(key, index));
    let mut number = || numbers.next().expect("endless");
    let mut file = ModelFile {
        kernel_size: None,
        kernel: Vec::new(),
        ..template
    };
    file.states.iter_mut().for_each(|state| state.bias = 0.0);
    if let Some((rows, cols)) = maps {
        let mut factor = |_| {
            if number() < 0.1 {
                0.0
            } else {
                2.0 * number() as f32
            }
        };
        let fuel = ArrayD::from_shape_fn(vec![rows, cols], &mut factor);
        let wind = ArrayD::from_shape_fn(vec![height, width, rows, cols], factor);
        let maps = [("fuel".to_owned(), fuel), ("wind".to_owned(), wind)].into();
        file.maps = Some(MapsEntry::packed(&maps));
    }
    for from in 0..n_states {
        for to in (0..n_states).filter(|&to| to != from) {
            if number() < 0.3 && file.transitions.len() > 1 {
                continue;
            }
            let mut probability = |most: f64| match number() {
                draw if draw < 0.3 => 0.0,
                draw if draw < 0.33 && most > 0.5 => 1.0,
                _ => 1e-9 + number() * most,
            };
            let base = probability(0.2);
            let mut table = || {
                let mut table = vec![vec![0.0; width]; height];
                table
                    .iter_mut()
                    .flatten()
                    .for_each(|p| *p = probability(0.6));
                table[height / 2][width / 2] = 0.0;
                table
            };
            let near = [(to, table()), (from, table())];
            let times = if maps.is_none() {
                &[][..]
            } else {
                &["fuel", "wind"]
            };
            file.transitions.push(TransitionEntry {
                from: format!("s{from}"),
                to: format!("s{to}"),
                base,
                times: times.iter().map(|&name| name.to_owned()).collect(),
                near: near
                    .into_iter()
                    .map(|(state, table)| (format!("s{state}"), table))
                    .collect(),
            });
        }
    }
    checked(file)
}

/// Computes each state's probability in each cell after a step, directly from the entries of the model file, as
/// explained in docs/model-file.md.
pub fn formula(model: &Model, p: &Array3<f64>) -> Array3<f64> {
    let (_, height, width) = p.dim();
    let mut next = Array3::zeros(p.dim());
    for cell in ndarray::indices((height, width)) {
        let of_cell = match model.hazards() {
            Some(_) => of_hazards(model, p, cell),
            None => of_ratio(model, p, cell),
        };
        for (to, probability) in of_cell.into_iter().enumerate() {
            next[[to, cell.0, cell.1]] = probability;
        }
    }
    next
}

/// Returns the probability that the neighbour at a place of a table is in a state.
fn neighbour(
    model: &Model,
    p: &Array3<f64>,
    (row, col): (usize, usize),
    [up, left]: [usize; 2],
    (a, c): (usize, usize),
    state: &String,
) -> f64 {
    let (i, j) = ((row + a).wrapping_sub(up), (col + c).wrapping_sub(left));
    let beyond = f64::from(model.file().edge.as_ref() == Some(state));
    let of = model.state_named(state).expect("a state");
    p.get([of, i, j]).copied().unwrap_or(beyond)
}

/// Paper eqs. 2 to 4.
fn of_ratio(model: &Model, p: &Array3<f64>, cell: (usize, usize)) -> Vec<f64> {
    let file = model.file();
    let size = file.kernel_size.expect("a kernel");
    let mut weights: Vec<f64> = file.states.iter().map(|state| state.bias).collect();
    for entry in &file.kernel {
        let to = model.state_named(&entry.to).expect("a state");
        for at in ndarray::indices((size[0], size[1])) {
            let x = neighbour(model, p, cell, size.map(|side| side / 2), at, &entry.from);
            weights[to] += entry.scale * entry.weights[at.0][at.1] * x;
        }
    }
    let sum: f64 = weights.iter().sum();
    weights.into_iter().map(|weight| weight / sum).collect()
}

/// `P(none of the first k) = prod (1 - base) prod over neighbours (1 - p)`; the first that happens wins. Neighbours
/// are independent.
fn of_hazards(model: &Model, p: &Array3<f64>, cell: (usize, usize)) -> Vec<f64> {
    let file = model.file();
    let maps = file
        .maps
        .as_ref()
        .map(|maps| maps.unpack().expect("packed"));
    let mut next = vec![0.0; file.states.len()];
    for (from, state) in file.states.iter().enumerate() {
        let here = p[[from, cell.0, cell.1]];
        let mut base = 1.0;
        // `1 - p` of the transitions so far, for each place and state of a neighbour.
        let mut near: BTreeMap<_, f64> = BTreeMap::new();
        let mut last = 1.0;
        for entry in file.transitions.iter().filter(|it| it.from == state.name) {
            let map = |name: &str| Some(&maps.as_ref()?[name]).filter(|_| !entry.times.is_empty());
            let fuel = map("fuel").map_or(1.0, |map| f64::from(map[[cell.0, cell.1]]));
            let power = |p: f64, factor: f64| {
                if factor == 0.0 {
                    1.0
                } else {
                    (1.0 - p).powf(factor)
                }
            };
            base *= power(entry.base, fuel);
            for (of, table) in &entry.near {
                let size = [table.len(), table[0].len()];
                for at in ndarray::indices((size[0], size[1])) {
                    let wind =
                        map("wind").map_or(1.0, |map| f64::from(map[[at.0, at.1, cell.0, cell.1]]));
                    let place = (size.map(|side| side / 2), at, of.clone());
                    *near.entry(place).or_insert(1.0) *= power(table[at.0][at.1], fuel * wind);
                }
            }
            let mut by_place: BTreeMap<_, f64> = BTreeMap::new();
            for ((centre, at, of), left) in &near {
                let x = neighbour(model, p, cell, *centre, *at, of);
                *by_place.entry((*centre, *at)).or_insert(1.0) -= x * (1.0 - left);
            }
            let none = base * by_place.values().product::<f64>();
            let to = model.state_named(&entry.to).expect("a state");
            next[to] += here * (last - none);
            last = none;
        }
        next[from] += here * last;
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
