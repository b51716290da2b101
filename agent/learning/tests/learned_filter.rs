//! Tests of the learned filter: equality with the known-model filter, and training.

use emberwatch_acting::config::{AgentConfig, LearningConfig};
use emberwatch_belief::Belief;
use emberwatch_belief::estimation::parameters::{Dimensions, Parameters, Tables};
use emberwatch_belief::estimation::{BayesFilter, Estimator};
use emberwatch_learning::gradient::{Optimiser, Update};
use emberwatch_learning::replay::BlockReplay;
use emberwatch_model::randomness::split_mix;
use emberwatch_model::{Frame, Model, Probabilities, Shape};
use ndarray::Axis;

/// A frame with observations of a few cells of a made-up world. Different frames observe different cells.
fn frame(shape: Shape, n_observations: usize, number: u64) -> Frame {
    let mut frame = Frame::empty(shape);
    let n_cells = shape.n_cells() as u64;
    for cell in (0..6).map(|n| split_mix(number, n) % n_cells) {
        let value = split_mix(cell, number / 100) % n_observations as u64;
        frame.observe(cell as usize, value as u8);
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

/// Returns the parameters of a model with a kernel. They omit the bias: beliefs sum to one, so away from the edges it has
/// the same effect as a neighbour's weight that is equal for all states of the neighbour.
fn tables(model: &Model) -> Tables {
    let ratio = model.ratio().expect("a kernel");
    let cast = |value: &f64| *value as f32;
    let (_, _, height, width) = ratio.kernel().dim();
    Tables {
        dimensions: Dimensions {
            n_states: model.n_states(),
            n_observations: model.n_observations(),
            kernel: (height, width),
        },
        kernel: ratio.kernel().iter().map(cast).collect(),
        likelihood: model.likelihood().iter().map(cast).collect(),
        initial: model.initial().iter().map(cast).collect(),
    }
}

#[test]
fn with_the_true_parameters_it_is_the_known_model_filter() {
    for name in ["wildfire", "road-ice"] {
        let model = Model::built_in(name).expect("a built-in model");
        for shape in [shape(1, 1), shape(20, 33)] {
            let prior = Belief::uniform(model.n_states(), shape);
            let mut known = BayesFilter::known(&model, prior.clone(), false).expect("valid model");
            let mut learned = BayesFilter::learned(&tables(&model), prior);
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
        replay.start_track(world);
        for number in 0..n_frames {
            let frame = frame(shape, 3, number * 2 + u64::from(world));
            replay.push(world, &frame, Some(&belief(3, shape, number)));
        }
    }
    replay
}

/// Returns the dimensions of a filter for the wildfire model.
fn dimensions() -> Dimensions {
    Dimensions {
        n_states: 3,
        n_observations: 3,
        kernel: (3, 3),
    }
}

fn optimiser(seed: u64) -> Optimiser {
    let parameters = Parameters::first(dimensions(), seed);
    Optimiser::new(parameters, shape(10, 12), config(), seed)
}

fn updates(n: usize, seed: u64) -> (Vec<Update>, Parameters) {
    let mut optimiser = optimiser(seed);
    let mut replay = replay(40);
    let mut update = || optimiser.update(&mut replay, Some(2)).expect("finite");
    let updates = (0..n).map(|_| update().expect("full")).collect();
    (updates, optimiser.parameters().clone())
}

#[test]
fn training_repeats_bit_for_bit_on_any_number_of_threads() {
    let on = |n_threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads);
        let pool = pool.build().expect("threads");
        pool.install(|| updates(10, 1))
    };
    let one = on(1);
    assert_eq!(one, on(2));
    assert_ne!(one.0, updates(10, 2).0, "another seed");
}

#[test]
fn training_lowers_the_loss() {
    let (updates, _) = updates(200, 3);
    let mean = |part: &[Update]| part.iter().map(|u| u.loss).sum::<f64>() / part.len() as f64;
    let (before, after) = (mean(&updates[..20]), mean(&updates[180..]));
    assert!(after < before - 0.1, "{before} {after}");
}

#[test]
fn a_non_finite_parameter_stops_training_with_an_error() {
    let mut parameters = Parameters::first(dimensions(), 0);
    parameters.tensors[1][4] = f32::NAN;
    let before = format!("{parameters:?}");
    let mut optimiser = Optimiser::new(parameters, shape(10, 12), config(), 0);
    let error = optimiser.update(&mut replay(40), None).expect_err("NaN");
    let words = "update 1: likelihood: expected finite numbers, got a NaN or infinite parameter";
    assert_eq!(error.to_string(), words);
    assert_eq!(format!("{:?}", optimiser.parameters()), before);
}
