//! Tests of the learned filter's training.

use emberwatch_acting::config::{AgentConfig, LearningConfig};
use emberwatch_belief::Belief;
use emberwatch_belief::estimation::parameters::{Dimensions, Parameters};
use emberwatch_learning::gradient::{Optimiser, Update};
use emberwatch_learning::replay::BlockReplay;
use emberwatch_model::randomness::split_mix;
use emberwatch_model::{Frame, Probabilities, Shape};

/// A frame with observations of a few cells of a made-up world. Different frames observe different cells.
fn frame(number: u64) -> Frame {
    let mut frame = Frame::empty(shape());
    for cell in (0..6).map(|n| split_mix(number, n) % 120) {
        frame.observe(cell as usize, (split_mix(cell, number / 100) % 3) as u8);
    }
    frame
}

fn shape() -> Shape {
    Shape::new(10, 12).expect("test shape")
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
    let mut replay = BlockReplay::new(8, 1000);
    for world in 0..2 {
        replay.start_track(world);
        for number in 0..n_frames {
            let frame = frame(number * 2 + u64::from(world));
            let p = 0.1 + number as f32 / 100.0;
            let states = Probabilities::from_shape_fn((3, 10, 12), |(state, _, col)| {
                [p, 0.5 - p, 0.5][(state + col) % 3]
            });
            let belief = Belief::from_probabilities(states).expect("sums of one");
            replay.push(world, &frame, Some(&belief));
        }
    }
    replay
}

/// Initial parameters of a filter for the wildfire model.
fn parameters(seed: u64) -> Parameters {
    let dimensions = Dimensions {
        n_states: 3,
        n_observations: 3,
        kernel: (3, 3),
    };
    Parameters::first(dimensions, seed)
}

fn updates(n: usize, seed: u64) -> Vec<Update> {
    let mut optimiser = Optimiser::new(parameters(seed), shape(), config(), seed);
    let mut replay = replay(40);
    let mut update = || optimiser.update(&mut replay, Some(2)).expect("finite");
    (0..n).map(|_| update().expect("full")).collect()
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
    assert_ne!(one, updates(10, 2), "another seed");
}

#[test]
fn training_lowers_the_loss() {
    let updates = updates(200, 3);
    let mean = |part: &[Update]| part.iter().map(|u| u.loss).sum::<f64>() / part.len() as f64;
    let (before, after) = (mean(&updates[..20]), mean(&updates[180..]));
    assert!(after < before - 0.1, "{before} {after}");
}

#[test]
fn a_non_finite_parameter_stops_training_with_an_error() {
    let mut parameters = parameters(0);
    parameters.tensors[1][4] = f32::NAN;
    let before = format!("{parameters:?}");
    let mut optimiser = Optimiser::new(parameters, shape(), config(), 0);
    let error = optimiser.update(&mut replay(40), None).expect_err("NaN");
    let words = "update 1: likelihood: expected finite numbers, got a NaN or infinite parameter";
    assert_eq!(error.to_string(), words);
    assert_eq!(format!("{:?}", optimiser.parameters()), before);
}
