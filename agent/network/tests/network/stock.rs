//! Comparison of our operators in 32 bits with candle's stock operators in 64 bits.
//!
//! The tests use windows of frames with fixed masks, on several grids, with several numbers of states and observations.
//! The gradient of a tensor passes through all later operators. A wrong operator therefore affects the gradients of its
//! own tensors and of all earlier tensors.

use crate::synthetic::{coin, dropout, frames, numbers, relative};
use candle_core::backprop::GradStore;
use candle_core::{DType, Device, Tensor};
use emberwatch_model::grid::Shape;
use emberwatch_network::variables::{Variables, build};
use emberwatch_network::{Network, NetworkShape, Operators, Pass, Window};

const FIRST: [f32; 5] = [0.3, -1.2, 0.7, 0.1, 2.0];

struct Model {
    network: Network,
    variables: Variables,
}

impl Model {
    fn new(shape: &NetworkShape, dtype: DType, operators: Operators) -> Self {
        let network = |vb| Network::new(&vb, shape, operators);
        let (network, variables) = build(3, dtype, &Device::Cpu, network).expect("a network");
        // Give the weights and biases of normalisations different values. Round all values to 32 bits.
        for (index, (name, var)) in variables.iter().enumerate() {
            let mut numbers = numbers(var);
            if var.rank() == 1 && !name.contains("running") {
                for (at, number) in numbers.iter_mut().enumerate() {
                    *number += 0.3 * ((7 * index + at) as f64).sin();
                }
            }
            let numbers: Vec<f32> = numbers.into_iter().map(|number| number as f32).collect();
            let tensor = Tensor::from_vec(numbers, var.shape(), &Device::Cpu);
            let tensor = tensor.and_then(|tensor| tensor.to_dtype(dtype));
            var.set(&tensor.expect("tensor")).expect("the same shape");
        }
        Self { network, variables }
    }

    fn loss(&self, pass: &Pass<'_>) -> (f64, GradStore) {
        let loss = self.network.loss(pass, &FIRST).expect("a loss");
        (numbers(&loss)[0], loss.backward().expect("gradients"))
    }
}

/// Compares losses, gradients and predictions on frames that show each cell with probability `1 / one_in`.
fn check(
    [height, width]: [usize; 2],
    [n_states, n_observations]: [usize; 2],
    (n_frames, one_in, drops): (u64, u64, bool),
    all: &[Operators],
) {
    let shape = NetworkShape {
        grid: Shape::new(height, width).expect("shape"),
        n_states,
        n_observations,
        encoding: 6,
        hidden: 5,
    };
    let frames = frames(shape.grid, n_observations as u64, n_frames, one_in);
    let scale = if drops { 2.0 } else { 1.0 };
    let keeps = |layer, frame, channel| !drops || coin(layer, frame, channel);
    let dropout = dropout(frames.len(), scale, keeps);
    let window = Window::new(&frames);
    let pass = Pass::training(&window, &dropout);
    let exact = Model::new(&shape, DType::F64, Operators::Stock);
    let (expected, derivatives) = exact.loss(&pass);
    for &operators in all {
        let model = Model::new(&shape, DType::F32, operators);
        let (got, gradients) = model.loss(&pass);
        let error = (got / expected - 1.0).abs();
        assert!(error < 1e-5, "{operators:?}: loss {got}, not {expected}");
        for (name, var) in &exact.variables {
            let Some(expected) = derivatives.get(var) else {
                assert!(name.contains("running"), "{name} has no gradient");
                continue;
            };
            let got = gradients.get(&model.variables[name]).expect("a gradient");
            let error = relative(&numbers(got), &numbers(expected));
            assert!(error < 1e-4, "{operators:?} {name}: off by {error}");
        }
        predictions_agree(&exact, &model, &window);
    }
}

/// Compares predictions, which use the initial running statistics.
fn predictions_agree(exact: &Model, model: &Model, window: &Window) {
    let predictions = [exact, model].map(|model| {
        let pass = Pass::inference(window);
        let hidden = model
            .network
            .forward(&pass, &FIRST)
            .expect("hidden vectors");
        let prediction = model.network.predict(&pass, &hidden);
        numbers(&prediction.expect("a prediction"))
    });
    let error = relative(&predictions[1], &predictions[0]);
    assert!(error < 1e-4, "predictions: off by {error}");
}

#[test]
fn operators_agree_with_stock_operators_in_64_bits() {
    use Operators::{Own, Stock};
    check([32, 48], [3, 3], (6, 9, true), &[Own, Stock]);
    // Full frames, then paths without dropout.
    check([64, 64], [3, 3], (6, 1, true), &[Own]);
    check([64, 64], [3, 3], (10, 100, false), &[Own]);
    // Other grids, states and observations. The network pads the last two grids.
    check([32, 32], [2, 4], (6, 100, true), &[Own]);
    check([48, 80], [4, 2], (6, 2, true), &[Own]);
    check([20, 33], [3, 3], (6, 10, true), &[Own]);
    check([6, 6], [3, 3], (6, 2, true), &[Own]);
}
