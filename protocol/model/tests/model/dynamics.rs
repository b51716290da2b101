//! Checks that steps of any model are drawn with the probabilities of the formula, and that worlds resemble the
//! authors' worlds.

use super::models::{
    formula, model, random_hazards, random_model, random_states, shape, with_edge,
};
use super::statistics;
use emberwatch_model::{Dynamics, Grid, Model, Shape};
use ndarray::{Array3, Axis, array};

fn burnout() -> Model {
    Model::built_in("wildfire-burnout").expect("built in")
}

/// Steps `states` many times and compares each cell's outcomes with their probabilities. The probability of exceeding 5
/// standard deviations by chance is below 1e-3, and below 1e-5 for 100 degrees of freedom.
fn check(model: &Model, states: &Grid<u8>, n_draws: u64) {
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
    let known = Array3::from_shape_fn(counts.dim(), |(state, row, col)| {
        f64::from(usize::from(states[[row, col]]) == state)
    });
    let expected = formula(model, &known) * n_draws as f64;
    let z = chi_square(&counts, &expected);
    assert!(z.abs() < 5.0, "{}: {z} standard deviations", model.name());
}

/// Returns the chi-square statistic of counts by cell and outcome, as its distance from the mean in standard
/// deviations. Outcomes expected fewer than 10 times share a bin, and impossible outcomes must not occur. Cells are
/// independent, so statistics and degrees of freedom add up. With d degrees of freedom, the sum has mean d and variance
/// 2d.
fn chi_square(counts: &Array3<f64>, expected: &Array3<f64>) -> f64 {
    let (mut sum, mut freedom) = (0.0, 0.0);
    let mut term = |observed: f64, expected: f64| {
        sum += (observed - expected).powi(2) / expected;
        freedom += 1.0;
    };
    for (observed, expected) in counts
        .lanes(Axis(0))
        .into_iter()
        .zip(expected.lanes(Axis(0)))
    {
        let mut rare = (0.0, 0.0);
        for (&observed, &expected) in observed.iter().zip(expected) {
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
    }
    freedom -= (counts.len() / counts.len_of(Axis(0))) as f64;
    (sum - freedom) / (2.0 * f64::max(freedom, 1.0)).sqrt()
}

#[test]
fn wildfires_are_drawn_from_the_formula() {
    for model in [
        Model::wildfire(),
        burnout(),
        with_edge(&Model::wildfire(), 1),
    ] {
        check(&model, &random_states(1, 3, (5, 6)), 100_000);
        // Several chunks and bands.
        check(&model, &random_states(3, 3, (3, 70)), 40_000);
        check(&model, &random_states(16, 3, (92, 91)), 2_000);
        for state in 0..3 {
            check(&model, &Grid::from_elem((1, 1), state), 100_000);
        }
    }
}

#[test]
fn random_models_are_drawn_from_the_formula() {
    for (key, n_states, kernel_size, side, n_draws) in [
        (4, 4, [5, 5], (7, 5), 100_000),
        // A kernel larger than the grid.
        (6, 6, [3, 7], (4, 3), 100_000),
        (8, 2, [1, 1], (2, 3), 100_000),
        // Too many weights for tables, so kernels are summed.
        (14, 64, [5, 5], (2, 2), 20_000),
    ] {
        let states = random_states(key + 1, n_states, side);
        let model = random_model(key, n_states, kernel_size);
        check(&model, &states, n_draws);
        check(&with_edge(&model, 3), &states, n_draws);
    }
}

#[test]
fn random_hazards_are_drawn_from_the_formula() {
    for (key, n_states, kernel_size, side, has_maps, n_draws) in [
        (4, 4, [5, 5], (7, 5), false, 100_000),
        // A table larger than the grid.
        (6, 6, [3, 7], (4, 3), false, 100_000),
        (8, 2, [1, 1], (2, 3), false, 100_000),
        (9, 64, [3, 3], (4, 4), false, 20_000),
        (10, 2, [15, 15], (9, 20), false, 20_000),
        // Several chunks and bands.
        (11, 3, [3, 3], (92, 91), false, 2_000),
        (12, 3, [3, 3], (7, 5), true, 100_000),
        (13, 3, [3, 5], (6, 140), true, 20_000),
    ] {
        let states = random_states(key + 1, n_states, side);
        let model = random_hazards(key, n_states, kernel_size, has_maps.then_some(side));
        check(&model, &states, n_draws);
        check(&with_edge(&model, 1), &states, n_draws);
    }
}

#[test]
fn cells_that_reject_almost_every_parent_are_drawn_from_the_formula() {
    // The weight of state 0 is 1e-4 of the weight of state 1, so a cell among neighbours in state 0 accepts a parent
    // once in 10,000 draws.
    let weight = |to, from, row, col| {
        let scale = if from == 0 { 1e-4 } else { 1.0 };
        scale * (1 + to + row * col) as f64
    };
    let uneven = model(2, [3, 3], weight, |_| 0.0);
    check(&uneven, &Grid::zeros((3, 4)), 100_000);
    check(&uneven, &random_states(12, 2, (4, 4)), 100_000);
}

#[test]
fn deterministic_models_move_as_they_must() {
    let shift_down = |bias| {
        let weight = |to, from, row, _| f64::from(row == 0 && to == from);
        model(3, [3, 1], weight, |to| if to == 2 { bias } else { 0.0 })
    };
    // All the weight is on neighbours beyond the edge, which do not exist.
    let error = Dynamics::new(&shift_down(0.0), shape(3, 2)).expect_err("no weight in row 0");
    assert!(error.to_string().contains("(0, 0)"), "{error}");
    for model in [with_edge(&shift_down(0.0), 2), shift_down(1e-20)] {
        let mut dynamics = Dynamics::new(&model, shape(3, 2)).expect("weights");
        let mut states = array![[0, 1], [1, 2], [2, 0]];
        dynamics.step(1, 0, &mut states);
        assert_eq!(states, array![[2, 2], [0, 1], [1, 2]]);
    }
}

/// Returns the FNV-1a hash (http://www.isthe.com/chongo/tech/comp/fnv) of a world after some steps. The same `Dynamics`
/// steps another world first, which must not matter.
fn hash_after(model: &Model, shape: Shape, n_steps: u64) -> u64 {
    let mut dynamics = Dynamics::new(model, shape).expect("test model");
    dynamics.step(8, 3, &mut dynamics.initial(8));
    let mut states = dynamics.initial(7);
    (0..n_steps).for_each(|n| dynamics.step(7, n, &mut states));
    let hash = |hash: u64, &state: &u8| (hash ^ u64::from(state)).wrapping_mul(0x100_0000_01b3);
    states.iter().fold(0xcbf2_9ce4_8422_2325, hash)
}

#[test]
fn a_trajectory_is_the_same_on_every_platform() {
    // If one of these hashes changes, the worlds of every published seed change too.
    let grid = shape(64, 64);
    let wildfire = hash_after(&Model::wildfire(), grid, 1000);
    assert_eq!(wildfire, 0x5b72_805c_3e44_c4a8);
    assert_eq!(hash_after(&burnout(), grid, 1000), 0x72c4_ef09_0ae2_3bf0);
    // Escapes, redraws and summed kernels all occur in these worlds.
    let random = hash_after(&random_model(4, 4, [5, 5]), shape(7, 5), 10_000);
    assert_eq!(random, 0x4974_9562_5f3d_1a6d);
    let hazards = random_hazards(4, 4, [5, 5], Some((7, 5)));
    assert_eq!(
        hash_after(&hazards, shape(7, 5), 10_000),
        0x8f9c_f37e_fe43_b4e0
    );
}

#[test]
fn worlds_look_like_the_authors() {
    // Compares means over 12 runs with the reference's 7 runs, whose burn-in is 15,000 steps, within 3 combined
    // standard errors. The example `world_statistics` compares all 46 statistics.
    let (ours, reference) = (statistics::simulate(100..112), statistics::reference());
    for name in [
        "mean_fraction_0",
        "mean_fraction_1",
        "mean_fraction_2",
        "changes_per_step",
        "cond_prob_1to2",
        "cond_prob_2to2",
        "p_fire_above_given_fire",
        "new_fire_fraction_with_above_on_fire_before",
        "new_fire_above_minus_below",
        "fire_bottom_minus_top",
    ] {
        let deviation = ours[name].deviation(reference[name]);
        assert!(
            deviation.abs() < 3.0,
            "{name}: {:?}, {deviation} se",
            ours[name]
        );
    }
    // The agreement is not only due to wide error bars: in the example, the drift of the fire is 20 standard errors
    // from zero.
    let drift = ours["new_fire_above_minus_below"];
    assert!(drift.mean > 5.0 * drift.se, "{drift:?}");
}
