//! Kernels that see the cell's own state, against their formula as it stands in docs/model-file.md, and the
//! worlds of `wildfire-burnout` against a simulation by the formula.

use super::models::{
    assert_close, check_draws, check_predictions, chi_square, hash_after, one_hot, predicted,
    random_belief, random_model, random_own_model, random_states, shape, unit,
};
use emberwatch_model::KernelEntry;
use emberwatch_model::{Dynamics, Grid, Model};
use ndarray::Array3;
use proptest::prelude::*;
use std::collections::BTreeMap;

/// `p`: each state's probability in each cell, from the entries of the model's file.
fn formula(model: &Model, p: &Array3<f64>) -> Array3<f64> {
    let (n_states, height, width) = p.dim();
    let mut next = Array3::zeros(p.dim());
    for (row, col) in ndarray::indices((height, width)) {
        for own in 0..n_states {
            let weights = weights(model, p, own, (row, col));
            let total: f64 = weights.iter().sum();
            for (to, weight) in weights.iter().enumerate() {
                next[[to, row, col]] += p[[own, row, col]] * weight / total;
            }
        }
    }
    next
}

fn weights(model: &Model, p: &Array3<f64>, own: usize, (row, col): (usize, usize)) -> Vec<f64> {
    let file = model.file();
    let state = |name: &str| model.state_named(name).expect("a state");
    let mut weights: Vec<f64> = file.states.iter().map(|state| state.bias).collect();
    let [up, left] = file.kernel_size.map(|side| side / 2);
    for entry in &file.kernel {
        let (from, to) = (state(&entry.from), state(&entry.to));
        if entry.own.as_deref().map(state) != Some(own) {
            continue;
        }
        for (a, values) in entry.weights.iter().enumerate() {
            for (c, value) in values.iter().enumerate() {
                let x = if (a, c) == (up, left) {
                    f64::from(u8::from(from == own))
                } else {
                    let at = ((row + a).wrapping_sub(up), (col + c).wrapping_sub(left));
                    p.get([from, at.0, at.1]).copied().unwrap_or(0.0)
                };
                weights[to] += entry.scale * value * x;
            }
        }
    }
    weights
}

/// Compares draws with the formula.
fn check(model: &Model, states: &Grid<u8>, n_draws: u64) {
    let expected = formula(model, &one_hot(model.n_states(), states));
    check_draws(model, states, n_draws, &expected);
}

fn burnout() -> Model {
    Model::built_in("wildfire-burnout").expect("a built-in model")
}

#[test]
fn burnout_steps_are_drawn_from_the_formula() {
    check(&burnout(), &random_states(1, 3, (5, 6)), 200_000);
    check(&burnout(), &random_states(2, 3, (3, 70)), 40_000);
    check(&burnout(), &random_states(3, 3, (92, 91)), 2_000);
    for state in 0..3 {
        check(&burnout(), &Grid::from_elem((1, 1), state), 200_000);
    }
}

#[test]
fn what_is_said_of_another_state_in_the_centre_means_nothing() {
    let model = random_own_model(3, 3, [3, 3]);
    let mut file = model.file().clone();
    for entry in &mut file.kernel {
        if entry.own.as_ref() != Some(&entry.from) {
            entry.weights[1][1] = 1e60;
        }
    }
    let belief = random_belief(3, 3, (4, 5)).mapv(|p| p as f32);
    let other = Model::new(file).expect("a model");
    assert_eq!(predicted(&other, &belief), predicted(&model, &belief));
}

#[test]
fn random_models_are_drawn_from_the_formula() {
    for (key, n_states, kernel_size, side, n_draws) in [
        (4, 4, [5, 5], (7, 5), 100_000),
        (6, 6, [3, 7], (4, 3), 100_000),
        (8, 2, [1, 1], (2, 3), 100_000),
        // Too many weights for tables: kernels are summed.
        (14, 24, [3, 3], (2, 2), 20_000),
    ] {
        let model = random_own_model(key, n_states, kernel_size);
        check(&model, &random_states(key + 1, n_states, side), n_draws);
    }
}

proptest! {
    // No file of failures: tests leave the source tree alone.
    #![proptest_config(ProptestConfig { cases: 100, failure_persistence: None, ..Default::default() })]

    #[test]
    fn predictions_are_those_of_the_formula(
        key in 0_u64..1_000_000,
        n_states in 2_usize..6,
        half_kernel in (0_usize..3, 0_usize..3),
        side in (1_usize..15, 1_usize..40),
    ) {
        let kernel_size = [2 * half_kernel.0 + 1, 2 * half_kernel.1 + 1];
        let model = random_own_model(key, n_states, kernel_size);
        let belief = random_belief(key, n_states, side);
        check_predictions(&model, &belief, &formula(&model, &belief));
    }
}

#[test]
fn one_kernel_for_each_state_is_that_of_all_where_states_are_known() {
    let plain = random_model(5, 3, [3, 3]);
    let mut file = plain.file().clone();
    file.kernel = (0..3)
        .flat_map(|own| {
            let of_own = |entry: &KernelEntry| KernelEntry {
                own: Some(format!("s{own}")),
                ..entry.clone()
            };
            plain.file().kernel.iter().map(of_own).collect::<Vec<_>>()
        })
        .collect();
    let own = Model::new(file).expect("test models are valid");
    let states = one_hot(3, &random_states(9, 3, (6, 9)));
    let (of_own, of_all) = (predicted(&own, &states), predicted(&plain, &states));
    assert_close(&of_own, &of_all, 1e-12);
}

#[test]
fn a_prediction_is_that_of_the_python_filter() {
    let json: serde_json::Value =
        serde_json::from_str(include_str!("../data/own_state.json")).expect("JSON");
    let array = |key: &str| {
        let numbers = serde_json::from_value::<Vec<Vec<Vec<f64>>>>(json[key].clone());
        let numbers = numbers.expect("numbers").concat().concat();
        Array3::from_shape_vec((3, 4, 5), numbers).expect("3 x 4 x 5 numbers")
    };
    let (belief, expected) = (array("belief"), array("prediction"));
    assert_close(&predicted(&burnout(), &belief), &expected, 1e-12);
}

#[test]
fn a_prediction_is_the_average_over_simulated_next_steps() {
    // Neighbours of an unburnt cell weigh alike in every state, so that eq. 3 divides by the same sum
    // whatever they are: the mean field is exact for cells that are independent.
    let (model, side) = (burnout(), (4, 5));
    let belief = random_belief(3, 3, side);
    let n_draws = 20_000;
    let mut average = Array3::<f64>::zeros(belief.dim());
    for draw in 0..n_draws {
        let states = Grid::from_shape_fn(side, |(row, col)| {
            let uniform = unit(17, (draw * 4 + row) * 5 + col);
            u8::from(uniform >= belief[[0, row, col]])
                + u8::from(uniform >= belief[[0, row, col]] + belief[[1, row, col]])
        });
        average += &formula(&model, &one_hot(3, &states));
    }
    average /= n_draws as f64;
    // A probability's standard error is at most .5 / sqrt(n): 60 of them within 4.5.
    let bound = 4.5 * 0.5 / (n_draws as f64).sqrt();
    assert_close(&average, &predicted(&model, &belief), bound);
}

/// Steps of the worlds whose statistics are taken.
const N_STEPS: u64 = 300;

/// What burns and what is burnt in a world over time: the share of its cells, and of pairs of neighbours.
fn statistics(mut step: impl FnMut(u64) -> Grid<u8>) -> [f64; 4] {
    let mut sums = [0.0; 4];
    for n in 0..N_STEPS {
        let states = step(n);
        for state in 1..3 {
            let of_cells = states.iter().filter(|&&it| it == state).count();
            let pairs = states.windows([1, 2]);
            let of_pairs = pairs
                .into_iter()
                .filter(|pair| pair.iter().all(|&it| it == state));
            sums[2 * usize::from(state) - 2] += of_cells as f64;
            sums[2 * usize::from(state) - 1] += of_pairs.count() as f64;
        }
    }
    sums.map(|sum| sum / (N_STEPS as f64))
}

#[test]
fn worlds_that_burn_out_are_those_of_a_simulation_by_the_formula() {
    let model = burnout();
    let mut dynamics = Dynamics::new(&model, shape(16, 20)).expect("a model");
    let n_worlds = 48;
    let (mut ours, mut theirs) = (Vec::new(), Vec::new());
    for seed in 0..n_worlds {
        let mut states = dynamics.initial(seed);
        let mut others = states.clone();
        ours.push(statistics(|n| {
            dynamics.step(seed, n, &mut states);
            states.clone()
        }));
        theirs.push(statistics(|n| {
            others = drawn(&model, &others, seed * N_STEPS + n);
            others.clone()
        }));
    }
    for index in 0..4 {
        let moments = |worlds: &[[f64; 4]]| {
            let n = worlds.len() as f64;
            let mean = worlds.iter().map(|world| world[index]).sum::<f64>() / n;
            let squares = worlds.iter().map(|world| (world[index] - mean).powi(2));
            (mean, squares.sum::<f64>() / (n * (n - 1.0)))
        };
        let ((mean, variance), (other, of_other)) = (moments(&ours), moments(&theirs));
        let z = (mean - other) / (variance + of_other).sqrt();
        assert!(
            mean > 1.0 && z.abs() < 4.0,
            "{index}: {mean} against {other}, {z} errors"
        );
    }
}

/// The next states, drawn from the formula cell by cell.
fn drawn(model: &Model, states: &Grid<u8>, key: u64) -> Grid<u8> {
    let known = one_hot(3, states);
    Grid::from_shape_fn(states.dim(), |(row, col)| {
        let own = usize::from(states[[row, col]]);
        let weights = weights(model, &known, own, (row, col));
        let total: f64 = weights.iter().sum();
        let mut rest = total * unit(1 + key, row * states.dim().1 + col);
        let next = weights.iter().position(|weight| {
            rest -= weight;
            rest < 0.0
        });
        next.unwrap_or(own) as u8
    })
}

/// Outcomes by the cell's own state and which neighbours burn, and those that the formula expects.
type Classes = BTreeMap<(u8, Vec<bool>), [[f64; 3]; 2]>;

#[test]
fn worlds_that_burn_out_move_as_the_formula_says() {
    let model = burnout();
    let mut classes = Classes::new();
    let mut dynamics = Dynamics::new(&model, shape(24, 33)).expect("a model");
    for seed in 0..6 {
        let mut states = dynamics.initial(seed);
        for n in 0..1_200 {
            let before = states.clone();
            dynamics.step(seed, n, &mut states);
            if n >= 200 && n % 4 == 0 {
                count(&model, &before, &states, &mut classes);
            }
        }
    }
    let seen = |own| classes.keys().filter(|class| class.0 == own).count();
    assert!(
        seen(0) > 50 && seen(1) > 1 && seen(2) > 1,
        "too few classes"
    );
    let tables = classes.into_values();
    let z = chi_square(tables.map(|[observed, expected]| (observed.into(), expected.into())));
    assert!(z.abs() < 5.0, "{z} standard deviations");
}

/// Counts cells away from the edges.
fn count(model: &Model, before: &Grid<u8>, after: &Grid<u8>, classes: &mut Classes) {
    let known = one_hot(3, before);
    for (row, col) in (1..23).flat_map(|row| (1..32).map(move |col| (row, col))) {
        let own = before[[row, col]];
        let burns = |(a, c): (usize, usize)| before[[row + a - 1, col + c - 1]] == 1;
        let neighbours = ndarray::indices((3, 3))
            .into_iter()
            .filter(|&at| at != (1, 1));
        let class = (own, neighbours.map(burns).collect());
        let [observed, expected] = classes.entry(class).or_default();
        observed[usize::from(after[[row, col]])] += 1.0;
        let weights = weights(model, &known, usize::from(own), (row, col));
        let total: f64 = weights.iter().sum();
        for (expected, weight) in expected.iter_mut().zip(weights) {
            *expected += weight / total;
        }
    }
}

#[test]
fn a_trajectory_is_the_same_on_every_platform() {
    // Pinned: if one changes, so does every published seed.
    assert_eq!(
        hash_after(&burnout(), shape(64, 64), 1000),
        15_190_413_380_503_145_369
    );
    let random = random_own_model(4, 4, [5, 5]);
    assert_eq!(
        hash_after(&random, shape(7, 5), 10_000),
        16_987_252_199_630_661_834
    );
}
