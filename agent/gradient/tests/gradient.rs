//! Compares the recursion and the learned filter with their definition, in f64, and gradients with finite differences.

use emberwatch_belief::estimation::parameters::{Dimensions, Parameters};
use emberwatch_belief::estimation::{BayesFilter, Estimator};
use emberwatch_gradient::{Recursion, Sighting};
use emberwatch_model::randomness::split_mix;
use emberwatch_model::{Cell, Frame, Shape};
use ndarray::ArrayView;

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

/// A belief `[S, H, W]` whose cells differ.
fn belief(n_states: usize, shape: Shape) -> Vec<f32> {
    let (n_cells, sum) = (shape.n_cells(), n_states * (n_states + 1) / 2);
    let number = |at: usize| 1 + (at / n_cells + at % n_cells) % n_states;
    (0..n_states * n_cells)
        .map(|at| number(at) as f32 / sum as f32)
        .collect()
}

fn shape(height: usize, width: usize) -> Shape {
    Shape::new(height, width).expect("test shape")
}

/// Computes `-ln P` of frames and the predictor after them, from their definitions. `tables` are the kernel, the
/// likelihood and the first belief.
fn loss(
    dimensions: Dimensions,
    tables: &[Vec<f64>; 3],
    shape: Shape,
    start: Option<&[f32]>,
    frames: &[Vec<Sighting>],
) -> (f64, Vec<f64>) {
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
    (loss, belief)
}

/// Computes eqs. 2 and 3 from their definitions.
fn predicted(dimensions: Dimensions, kernel: &[f64], shape: Shape, belief: &[f64]) -> Vec<f64> {
    let (n_states, (rows, cols)) = (dimensions.n_states, dimensions.kernel);
    let n_cells = shape.n_cells();
    let dim = (n_states, n_states, rows, cols);
    let kernel = ArrayView::from_shape(dim, kernel).expect("a weight of each");
    let mut predicted = vec![0.0; n_states * n_cells];
    for cell in 0..n_cells {
        let Cell { row, col } = shape.cell(cell);
        let mut weights = vec![0.0; n_states];
        for ((to, from, down, right), weight) in kernel.indexed_iter() {
            let near = Cell {
                row: (row + down).wrapping_sub(rows / 2),
                col: (col + right).wrapping_sub(cols / 2),
            };
            if shape.contains(near) {
                weights[to] += weight * belief[from * n_cells + shape.index(near)];
            }
        }
        let sum: f64 = weights.iter().sum();
        for (to, weight) in weights.iter().enumerate() {
            predicted[to * n_cells + cell] = weight / sum;
        }
    }
    predicted
}

fn check_gradients(dimensions: Dimensions, shape: Shape, from_belief: bool) {
    let tables = Parameters::first(dimensions, 11).tables();
    let frames: Vec<_> = (0..5)
        .map(|number| sightings(shape, dimensions.n_observations, number))
        .collect();
    let belief = belief(dimensions.n_states, shape);
    let start = from_belief.then_some(belief.as_slice());
    let mut end = vec![0.0; belief.len()];
    let outcome = Recursion::new(tables.clone(), shape, 5).run(start, &frames, &mut end);
    let filter_tables = tables.clone();
    let numbers = [tables.kernel, tables.likelihood, tables.initial];
    let numbers = numbers.map(|table| table.into_iter().map(f64::from).collect::<Vec<f64>>());
    let (expected, predictor) = loss(dimensions, &numbers, shape, start, &frames);
    let off = (outcome.log_likelihood + expected).abs();
    assert!(off < 1e-4, "{expected}");
    let prior = filter_tables.prior(shape);
    let mut filter = BayesFilter::learned(&filter_tables, prior);
    for sightings in &frames {
        let mut frame = Frame::empty(shape);
        let seen = sightings.iter().map(|it| (it.cell as usize, it.value));
        seen.for_each(|(cell, value)| frame.observe(cell, value));
        filter.correct(&frame).expect("possible");
        filter.predict();
    }
    let filter = filter.belief().as_slice().iter().filter(|_| !from_belief);
    let near = |(got, expected): (&f32, &f64)| (f64::from(*got) - expected).abs() < 1e-6;
    assert!(end.iter().zip(&predictor).all(near));
    assert!(filter.zip(&predictor).all(near));
    for (which, gradient) in outcome.gradient.iter().enumerate() {
        for (entry, &got) in gradient.iter().enumerate() {
            let moved = |by: f64| {
                let mut moved = numbers.clone();
                moved[which][entry] += by;
                loss(dimensions, &moved, shape, start, &frames).0
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
fn losses_predictions_and_gradients_agree_with_their_definitions() {
    for (n_states, n_observations, kernel, shape, from_belief) in [
        (3, 3, (3, 3), shape(6, 7), false),
        (3, 3, (3, 3), shape(6, 7), true),
        (2, 3, (1, 5), shape(4, 19), false),
        (4, 2, (5, 3), shape(9, 70), true),
        (7, 4, (3, 1), shape(3, 2), false),
    ] {
        let dimensions = Dimensions {
            n_states,
            n_observations,
            kernel,
        };
        check_gradients(dimensions, shape, from_belief);
    }
}
