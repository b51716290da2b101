//! Models other than the wildfire, random states and beliefs, and the checks of what becomes of them.

use emberwatch_model::randomness::split_mix;
use emberwatch_model::{Dynamics, Grid, Model, Shape, Transition};
use emberwatch_model::{KernelEntry, ModelFile};
use ndarray::{Array3, Axis, NdFloat};

/// A model with weights `weight(to, from, row, col)` and biases `bias(to)`.
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
    for (to, from) in (0..n_states).flat_map(|to| (0..n_states).map(move |from| (to, from))) {
        let row = |row| {
            (0..kernel_size[1])
                .map(|col| weight(to, from, row, col))
                .collect()
        };
        file.kernel.push(KernelEntry {
            zone: None,
            own: None,
            from: name(from),
            to: name(to),
            scale: 1.0,
            weights: (0..kernel_size[0]).map(row).collect(),
        });
    }
    Model::new(file).expect("test models are valid")
}

/// The same with cells outside the grid that are always in a state.
pub fn with_edge(model: &Model, key: u64) -> Model {
    let mut file = model.file().clone();
    let state = key as usize % model.n_states();
    file.edge = Some(file.states[state].name.clone());
    Model::new(file).expect("test models are valid")
}

/// Random weights, a third of them zero, and random biases.
pub fn random_model(key: u64, n_states: usize, [height, width]: [usize; 2]) -> Model {
    let weight = |to, from, row, col| {
        let index = ((to * n_states + from) * height + row) * width + col;
        if split_mix(key, index as u64).is_multiple_of(3) {
            0.0
        } else {
            unit(key + 1, index)
        }
    };
    model(n_states, [height, width], weight, |to| unit(key + 2, to))
}

/// The same with a kernel for each state that a cell itself is in; in some of them neighbours don't count.
pub fn random_own_model(key: u64, n_states: usize, kernel_size: [usize; 2]) -> Model {
    let mut file = random_model(key, n_states, kernel_size).file().clone();
    file.kernel.clear();
    for own in 0..n_states {
        let of_all = random_model(key + 10 * own as u64, n_states, kernel_size);
        let ignores_neighbours = own > 0 && split_mix(key, own as u64).is_multiple_of(2);
        for entry in &of_all.file().kernel {
            let mut entry = entry.clone();
            entry.own = Some(format!("s{own}"));
            for (row, weights) in entry.weights.iter_mut().enumerate() {
                for (col, weight) in weights.iter_mut().enumerate() {
                    let is_centre = [row, col] == kernel_size.map(|side| side / 2);
                    *weight *= f64::from(u8::from(is_centre || !ignores_neighbours));
                }
            }
            file.kernel.push(entry);
        }
    }
    Model::new(file).expect("test models are valid")
}

/// A number in `[0, 1)`.
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

/// A random belief, each cell's summing to one.
pub fn random_belief(key: u64, n_states: usize, (height, width): (usize, usize)) -> Array3<f64> {
    let mut belief = Array3::from_shape_fn((n_states, height, width), |(state, row, col)| {
        unit(key, (state * height + row) * width + col)
    });
    let sums = belief.sum_axis(Axis(0));
    belief /= &sums;
    belief
}

/// The belief that is sure of these states.
pub fn one_hot(n_states: usize, states: &Grid<u8>) -> Array3<f64> {
    let (height, width) = states.dim();
    Array3::from_shape_fn((n_states, height, width), |(state, row, col)| {
        f64::from(u8::from(usize::from(states[[row, col]]) == state))
    })
}

/// `Phi` of a belief.
pub fn predicted<T: NdFloat>(model: &Model, belief: &Array3<T>) -> Array3<T> {
    let (_, height, width) = belief.dim();
    let mut out = Array3::zeros(belief.dim());
    let transition = Transition::new(model, shape(height, width));
    transition.expect("test model").apply(belief, &mut out);
    out
}

pub fn assert_close(got: &Array3<f64>, expected: &Array3<f64>, bound: f64) {
    let differences = got - expected;
    assert!(differences.iter().all(|it| it.abs() < bound));
}

/// Checks `Phi` of a belief in both precisions; it stays on the simplex.
pub fn check_predictions(model: &Model, belief: &Array3<f64>, expected: &Array3<f64>) {
    assert_close(&predicted(model, belief), expected, 1e-12);
    let single = predicted(model, &belief.mapv(|p| p as f32));
    assert!(single.iter().all(|&p| (0.0..=1.0 + 1e-6).contains(&p)));
    let mut sums = single.sum_axis(Axis(0)).into_iter();
    assert!(sums.all(|sum| (sum - 1.0).abs() < 1e-6));
    assert_close(&single.mapv(f64::from), expected, 2e-6);
}

/// Steps `states` often and compares each cell's outcomes with their probabilities: 5 standard deviations are exceeded
/// by chance with probability < 1e-3, and < 1e-5 for 100 degrees of freedom.
pub fn check_draws(model: &Model, states: &Grid<u8>, n_draws: u64, probabilities: &Array3<f64>) {
    let (height, width) = states.dim();
    let mut dynamics = Dynamics::new(model, shape(height, width)).expect("test model");
    let mut counts = Array3::<f64>::zeros((model.n_states(), height, width));
    let mut next = states.clone();
    for n in 0..n_draws {
        next.assign(states);
        dynamics.step(11, n, &mut next);
        for ((row, col), &state) in next.indexed_iter() {
            counts[[usize::from(state), row, col]] += 1.0;
        }
    }
    let expected = probabilities * n_draws as f64;
    let cells = counts.lanes(Axis(0)).into_iter();
    let pairs = cells.zip(expected.lanes(Axis(0)));
    let z = chi_square(pairs.map(|(counts, expected)| (counts.to_vec(), expected.to_vec())));
    assert!(z.abs() < 5.0, "{z} standard deviations");
}

/// Chi-square of counts by cell class and outcome, in standard deviations. Outcomes expected fewer than 10 times share a
/// bin, impossible ones must not occur. Classes are independent, so statistics and degrees of freedom add up; with d
/// degrees of freedom the sum has mean d and variance 2d.
pub fn chi_square(classes: impl Iterator<Item = (Vec<f64>, Vec<f64>)>) -> f64 {
    let (mut sum, mut freedom) = (0.0, 0.0);
    let mut term = |observed: f64, expected: f64| {
        sum += (observed - expected).powi(2) / expected;
        freedom += 1.0;
    };
    let mut n_classes = 0.0;
    for (observed, expected) in classes {
        let mut rare = (0.0, 0.0);
        for (observed, expected) in observed.into_iter().zip(expected) {
            if expected == 0.0 {
                assert_eq!(observed, 0.0, "an impossible outcome");
            } else if expected < 10.0 {
                rare = (rare.0 + observed, rare.1 + expected);
            } else {
                term(observed, expected);
            }
        }
        if rare.1 > 0.0 {
            term(rare.0, rare.1);
        }
        n_classes += 1.0;
    }
    let freedom: f64 = freedom - n_classes;
    (sum - freedom) / (2.0 * freedom.max(1.0)).sqrt()
}

/// FNV-1a (http://www.isthe.com/chongo/tech/comp/fnv) of a world after some steps.
pub fn hash_after(model: &Model, shape: Shape, n_steps: u64) -> u64 {
    let mut dynamics = Dynamics::new(model, shape).expect("test model");
    let mut states = dynamics.initial(7);
    (0..n_steps).for_each(|n| dynamics.step(7, n, &mut states));
    let hash = |hash: u64, &state: &u8| (hash ^ u64::from(state)).wrapping_mul(0x100_0000_01b3);
    states.iter().fold(0xcbf2_9ce4_8422_2325, hash)
}
