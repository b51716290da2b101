//! Tests of the learned filter: equality with the known-model filter, gradients against finite differences, and
//! training.

use emberwatch_belief::Belief;
use emberwatch_belief::estimation::parameters::{Dimensions, Parameters, Tables};
use emberwatch_belief::estimation::{BayesFilter, Estimator};
use emberwatch_learning::config::{AgentConfig, LearningConfig};
use emberwatch_learning::gradient::{Optimiser, Recursion, Update};
use emberwatch_learning::replay::{BlockReplay, Sighting};
use emberwatch_model::randomness::split_mix;
use emberwatch_model::{Cell, Frame, Model, Probabilities, Shape};
use ndarray::{ArrayView, Axis};

/// Observations of a few cells of a made-up world. Different frames observe different cells.
fn sightings(shape: Shape, n_observations: usize, frame: u64) -> Vec<Sighting> {
    let n_cells = shape.n_cells() as u64;
    let mut cells: Vec<u64> = (0..6).map(|n| split_mix(frame, n) % n_cells).collect();
    cells.sort_unstable();
    cells.dedup();
    let sighting = |cell: u64| Sighting {
        cell: cell as u32,
        value: (split_mix(cell, frame / 100) % n_observations as u64) as u8,
    };
    cells.into_iter().map(sighting).collect()
}

fn frame(shape: Shape, n_observations: usize, number: u64) -> Frame {
    let mut frame = Frame::empty(shape);
    for seen in sightings(shape, n_observations, number) {
        frame.observe(seen.cell as usize, seen.value);
    }
    frame
}

fn belief(n_states: usize, shape: Shape, seed: u64) -> Belief {
    let (height, width) = shape.dim();
    let mut at = 0;
    let numbers = Probabilities::from_shape_fn((n_states, height, width), |_| {
        at += 1;
        0.1 + (split_mix(seed, at) >> 40) as f32 / 2e7
    });
    let sums = numbers.sum_axis(Axis(0));
    Belief::from_probabilities(numbers / sums).expect("sums of one")
}

fn shape(height: usize, width: usize) -> Shape {
    Shape::new(height, width).expect("test shape")
}

/// The maximum difference between two beliefs.
fn off(a: &Belief, b: &Belief) -> f32 {
    let differences = (&a.view() - &b.view()).mapv(f32::abs);
    differences.fold(0.0, |worst, d| d.max(worst))
}

#[test]
fn with_the_true_parameters_it_is_the_known_model_filter() {
    for name in ["wildfire", "road-ice", "wildfire-burnout"] {
        let model = Model::built_in(name).expect("a built-in model");
        for shape in [shape(1, 1), shape(20, 33)] {
            let prior = Belief::uniform(model.n_states(), shape);
            let mut known = BayesFilter::known(&model, prior.clone()).expect("valid model");
            let mut learned = BayesFilter::learned(&Tables::of_model(&model), prior);
            for number in 0..30 {
                let frame = frame(shape, model.n_observations(), number);
                for filter in [&mut known, &mut learned] {
                    filter.correct(&frame).expect("possible");
                    filter.predict();
                }
            }
            // 30 steps with rounding errors of 6e-8 each.
            let off = off(known.belief(), learned.belief());
            assert!(off < 1e-5, "{name} on {shape}: {off}");
        }
    }
}

/// Computes `-ln P` of frames from its definition, in f64. `tables` are the kernel, the likelihood and the first
/// belief.
fn loss(
    dimensions: Dimensions,
    tables: &[Vec<f64>; 3],
    shape: Shape,
    start: Option<&[f32]>,
    frames: &[Vec<Sighting>],
) -> f64 {
    let [kernel, likelihood, initial] = tables;
    let (n_states, n_cells) = (dimensions.n_states, shape.n_cells());
    let mut belief: Vec<f64> = match start {
        Some(belief) => belief.iter().map(|&p| f64::from(p)).collect(),
        None => initial.iter().flat_map(|&p| vec![p; n_cells]).collect(),
    };
    let mut loss = 0.0;
    for frame in frames {
        for seen in frame {
            let (cell, value) = (seen.cell as usize, usize::from(seen.value));
            let seen_as = |state: usize| likelihood[state * dimensions.n_observations + value];
            let joint = |state: usize| belief[state * n_cells + cell] * seen_as(state);
            let joint: Vec<f64> = (0..n_states).map(joint).collect();
            let evidence: f64 = joint.iter().sum();
            loss -= evidence.ln();
            for (state, p) in joint.iter().enumerate() {
                belief[state * n_cells + cell] = p / evidence;
            }
        }
        belief = predicted(dimensions, kernel, shape, &belief);
    }
    loss
}

/// Computes eqs. 2 and 3 from their definitions.
fn predicted(dimensions: Dimensions, kernel: &[f64], shape: Shape, belief: &[f64]) -> Vec<f64> {
    let (n_states, (rows, cols)) = (dimensions.n_states, dimensions.kernel);
    let (n_cells, sees_own) = (shape.n_cells(), dimensions.sees_own_state);
    let dim = (dimensions.n_own(), n_states, n_states, rows, cols);
    let kernel = ArrayView::from_shape(dim, kernel).expect("a weight of each");
    let mut predicted = vec![0.0; n_states * n_cells];
    for cell in 0..n_cells {
        let Cell { row, col } = shape.cell(cell);
        for (own, kernel) in kernel.outer_iter().enumerate() {
            let mut weights = vec![0.0; n_states];
            for ((to, from, down, right), weight) in kernel.indexed_iter() {
                let near = Cell {
                    row: (row + down).wrapping_sub(rows / 2),
                    col: (col + right).wrapping_sub(cols / 2),
                };
                weights[to] += if !shape.contains(near) {
                    0.0
                } else if sees_own && near == (Cell { row, col }) {
                    weight * f64::from(u8::from(from == own))
                } else {
                    weight * belief[from * n_cells + shape.index(near)]
                };
            }
            let own = if sees_own {
                belief[own * n_cells + cell]
            } else {
                1.0
            };
            let sum: f64 = weights.iter().sum();
            for (to, weight) in weights.iter().enumerate() {
                predicted[to * n_cells + cell] += own * weight / sum;
            }
        }
    }
    predicted
}

fn check_gradients(dimensions: Dimensions, shape: Shape, from_belief: bool) {
    let tables = Parameters::first(dimensions, 11).tables();
    let frames: Vec<_> = (0..5)
        .map(|number| sightings(shape, dimensions.n_observations, number))
        .collect();
    let belief = belief(dimensions.n_states, shape, 4);
    let start = from_belief.then_some(belief.as_slice());
    let mut end = vec![0.0; belief.as_slice().len()];
    let outcome = Recursion::new(tables.clone(), shape, 5).run(start, &frames, &mut end);
    let numbers = [tables.kernel, tables.likelihood, tables.initial];
    let numbers = numbers.map(|table| table.into_iter().map(f64::from).collect::<Vec<f64>>());
    let expected = -loss(dimensions, &numbers, shape, start, &frames);
    let off = (outcome.log_likelihood - expected).abs();
    assert!(off < 1e-4, "{expected}");
    for (which, gradient) in outcome.gradient.iter().enumerate() {
        for (entry, &got) in gradient.iter().enumerate() {
            let moved = |by: f64| {
                let mut moved = numbers.clone();
                moved[which][entry] += by;
                loss(dimensions, &moved, shape, start, &frames)
            };
            // The error of central differences is about the squared step, 1e-10. The error of the f32 sums is larger.
            let expected = (moved(1e-5) - moved(-1e-5)) / 2e-5;
            let is_close = (got - expected).abs() <= 1e-4 * expected.abs().max(1.0);
            assert!(
                is_close,
                "{dimensions:?} {shape} {which} {entry}: {got}, not {expected}"
            );
        }
    }
}

#[test]
fn every_gradient_agrees_with_finite_differences() {
    for sees_own_state in [false, true] {
        let height = if sees_own_state { 2 } else { 9 };
        for (n_states, n_observations, kernel, shape, from_belief) in [
            (3, 3, (3, 3), shape(6, 7), false),
            (3, 3, (3, 3), shape(6, 7), true),
            (2, 3, (1, 5), shape(4, 19), false),
            (4, 2, (5, 3), shape(height, 70), true),
            (7, 4, (3, 1), shape(3, 2), false),
        ] {
            let dimensions = Dimensions {
                n_states,
                n_observations,
                kernel,
                sees_own_state,
                n_matrices: 1,
            };
            check_gradients(dimensions, shape, from_belief);
        }
    }
}

#[test]
fn a_window_ends_with_the_filters_prediction() {
    let burnout = Model::built_in("wildfire-burnout").expect("a built-in model");
    for tables in [
        Parameters::first(dimensions(false), 2).tables(),
        Parameters::first(dimensions(true), 2).tables(),
        Tables::of_model(&burnout),
    ] {
        let shape = shape(7, 18);
        let mut filter = BayesFilter::learned(&tables, tables.prior(shape));
        let mut window = Recursion::new(tables, shape, 8);
        let frames: Vec<_> = (0..8).map(|number| sightings(shape, 3, number)).collect();
        let mut end = vec![0.0; 3 * shape.n_cells()];
        window.run(None, &frames, &mut end);
        for number in 0..8 {
            filter.correct(&frame(shape, 3, number)).expect("possible");
            filter.predict();
        }
        let pairs = filter.belief().as_slice().iter().zip(&end);
        let most = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(most < 1e-6, "{most}");
    }
}

#[test]
fn initial_kernels_are_similar_for_every_own_state() {
    let prior = belief(3, shape(12, 40), 0);
    let [one, own] = [false, true].map(|sees_own_state| {
        let tables = Parameters::first(dimensions(sees_own_state), 0).tables();
        let mut filter = BayesFilter::learned(&tables, prior.clone());
        filter.predict();
        filter.belief().clone()
    });
    // The weights differ by 10 % noise.
    assert!(off(&one, &own) < 0.05);
}

fn config() -> LearningConfig {
    LearningConfig {
        window: 4,
        streams: 5,
        block_windows: 2,
        ..AgentConfig::default().learning
    }
}

/// A replay buffer with frames of two worlds, with enough blocks for [`config`].
fn replay(n_frames: u64) -> BlockReplay {
    let shape = shape(10, 12);
    let mut replay = BlockReplay::new(8, 1000);
    for world in 0..2 {
        replay.begin(world);
        for number in 0..n_frames {
            let frame = frame(shape, 3, number * 2 + u64::from(world));
            replay.push(world, &frame, Some(&belief(3, shape, number)));
        }
    }
    replay
}

/// Returns the dimensions of a filter for the wildfire model.
pub fn dimensions(sees_own_state: bool) -> Dimensions {
    Dimensions {
        n_states: 3,
        n_observations: 3,
        kernel: (3, 3),
        sees_own_state,
        n_matrices: 1,
    }
}

fn optimiser(sees_own_state: bool, seed: u64) -> Optimiser {
    let parameters = Parameters::first(dimensions(sees_own_state), seed);
    Optimiser::new(parameters, shape(10, 12), config(), seed)
}

fn updates(n: usize, sees_own_state: bool, seed: u64) -> (Vec<Update>, Parameters) {
    let mut optimiser = optimiser(sees_own_state, seed);
    let mut replay = replay(40);
    let mut update = || optimiser.update(&mut replay, Some(2)).expect("finite");
    let updates = (0..n).map(|_| update().expect("full")).collect();
    (updates, optimiser.parameters().clone())
}

#[test]
fn training_repeats_bit_for_bit_on_any_number_of_threads() {
    for sees_own_state in [false, true] {
        let on = |n_threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads);
            let pool = pool.build().expect("threads");
            pool.install(|| updates(10, sees_own_state, 1))
        };
        let one = on(1);
        assert_eq!(one, on(2));
        assert_ne!(one.0, updates(10, sees_own_state, 2).0, "another seed");
    }
}

#[test]
fn training_lowers_the_loss() {
    for sees_own_state in [false, true] {
        let (updates, _) = updates(200, sees_own_state, 3);
        let mean = |part: &[Update]| part.iter().map(|u| u.loss).sum::<f64>() / part.len() as f64;
        let (before, after) = (mean(&updates[..20]), mean(&updates[180..]));
        assert!(after < before - 0.1, "{before} {after}");
    }
}

#[test]
fn training_waits_for_a_block_for_each_stream() {
    let mut replay = replay(16); // 4 blocks
    let update = optimiser(false, 0).update(&mut replay, None);
    assert_eq!(update.expect("finite"), None);
}

#[test]
fn a_non_finite_parameter_stops_training_with_an_error() {
    let mut parameters = Parameters::first(dimensions(false), 0);
    parameters.tensors[1][4] = f32::NAN;
    let before = format!("{parameters:?}");
    let mut optimiser = Optimiser::new(parameters, shape(10, 12), config(), 0);
    let error = optimiser.update(&mut replay(40), None).expect_err("NaN");
    let words = "update 1: likelihood: expected finite numbers, got a NaN or infinite parameter";
    assert_eq!(error.to_string(), words);
    assert_eq!(format!("{:?}", optimiser.parameters()), before);
}
