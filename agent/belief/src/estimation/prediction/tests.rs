mod exact;

use super::*;
use emberwatch_model::grid::Probabilities;
use emberwatch_model::randomness::split_mix;
use emberwatch_model::transition::Transition;
use emberwatch_model::{Grid, Model};
use exact::divergences;
use ndarray::{Array3, Array4, Axis, s};

const KINDS: [PredictionKind; 3] = [
    PredictionKind::MeanField,
    PredictionKind::SecondOrder,
    PredictionKind::Cavities,
];

fn shape(height: usize, width: usize) -> Shape {
    Shape::new(height, width).expect("test shape")
}

/// Returns a pseudo-random number in `0..1`.
fn random(seed: u64, at: usize) -> f64 {
    (split_mix(seed, at as u64) >> 11) as f64 / (1_u64 << 53) as f64
}

fn belief(n_states: usize, shape: Shape) -> Belief {
    let (height, width) = shape.dim();
    let numbers = Probabilities::from_shape_fn((n_states, height, width), |(state, row, col)| {
        random(3, (state * 100 + row) * 100 + col) as f32 + 0.01
    });
    let sums = numbers.sum_axis(Axis(0));
    Belief::from_probabilities(numbers / sums).expect("a belief")
}

fn predict(prediction: &mut Prediction, belief: &mut Belief) {
    let before = belief.as_slice().to_vec();
    prediction.predict(&before, belief.as_mut_slice());
}

/// Returns the largest difference between two beliefs.
fn off(got: &Probabilities, expected: &Probabilities) -> f32 {
    let differences = (got - expected).mapv(f32::abs);
    differences.fold(0.0, |worst, d| d.max(worst))
}

#[test]
fn the_mean_field_is_the_transition() {
    for name in [
        "wildfire",
        "wildfire-burnout",
        "wildfire-terrain",
        "road-ice",
        "wildfire-sparse",
    ] {
        let model = Model::built_in(name).expect("built in");
        let shape = match model.zone_map() {
            Some(map) => shape(map.nrows(), map.ncols()),
            None => shape(9, 37),
        };
        let mut got = belief(model.n_states(), shape);
        let mut transition = Transition::new(&model, shape).expect("a transition");
        let mut expected = got.probabilities().clone();
        transition.apply(got.probabilities(), &mut expected);
        let mut prediction = Prediction::new((&model).into(), PredictionKind::MeanField, &got);
        predict(&mut prediction, &mut got);
        assert!(off(got.probabilities(), &expected) < 2e-6, "{name}");
    }
}

/// Surrounds a belief with a border of cells that are certainly in state 1.
fn framed(inner: &Belief) -> Belief {
    let (height, width) = inner.shape().dim();
    let mut framed = Array3::zeros((inner.n_states(), height + 2, width + 2));
    framed.index_axis_mut(Axis(0), 1).fill(1.0);
    let mut cells = framed.slice_mut(s![.., 1..=height, 1..=width]);
    cells.assign(&inner.view());
    Belief::from_probabilities(framed).expect("a belief")
}

#[test]
fn an_edge_state_equals_a_border_of_cells_in_that_state() {
    let kernels = fire();
    let weights = weights(&kernels, &[0.0; 3]);
    let with_edge = Weights {
        edge: Some(1),
        ..weights
    };
    for kind in KINDS {
        let mut got = belief(3, shape(5, 7));
        let mut expected = framed(&got);
        let mut prediction = Prediction::new(with_edge, kind, &got);
        let mut of_frame = Prediction::new(weights, kind, &expected);
        for step in 0..4 {
            predict(&mut prediction, &mut got);
            predict(&mut of_frame, &mut expected);
            let inner = expected.view().slice(s![.., 1..6, 1..8]).to_owned();
            let off = off(got.probabilities(), &inner);
            assert!(off < 2e-6, "{kind:?}, step {step}: {off}");
            let reset = framed(&got);
            of_frame.correct(expected.as_slice(), reset.as_slice());
            expected = reset;
        }
    }
}

#[test]
fn the_scale_of_weights_does_not_change_predictions() {
    let kernels = fire();
    for exponent in [-300, 300] {
        let scale = 2.0_f64.powi(exponent);
        let scaled: Vec<_> = kernels.iter().map(|kernel| kernel * scale).collect();
        for kind in [PredictionKind::SecondOrder, PredictionKind::Cavities] {
            let [got, expected] = [&scaled, &kernels].map(|kernels| {
                let mut belief = belief(3, shape(4, 5));
                let weights = weights(kernels, &[0.0; 3]);
                predict(&mut Prediction::new(weights, kind, &belief), &mut belief);
                belief
            });
            assert_eq!(got, expected, "{kind:?}, 2^{exponent}");
        }
    }
}

/// Returns weights for a grid without zones or an edge state.
fn weights<'a>(kernels: &'a [Array4<f64>], bias: &'a [f64]) -> Weights<'a> {
    Weights {
        kernels,
        bias,
        zones: (None, 1),
        edge: None,
    }
}

/// Returns the kernels of a fire. A cell ignites with probability `f / (a f + b)` if `f` of its four neighbours burn. A
/// burning cell burns out with probability 0.1.
fn fire() -> Vec<Array4<f64>> {
    let (a, b) = (0.7, 1.8);
    let mut kernels = vec![Array4::zeros((3, 3, 3, 3)); 3];
    for (row, col) in [(0, 1), (1, 0), (1, 2), (2, 1)] {
        kernels[0][[1, 1, row, col]] = 1.0;
        for n in [0, 2] {
            kernels[0][[0, n, row, col]] = 1.0 - a;
        }
    }
    // The centre compensates for the weights of neighbours that do not burn.
    kernels[0][[0, 0, 1, 1]] = b - 4.0 * (1.0 - a);
    for (m, p) in [(1, 0.9), (2, 0.1)] {
        kernels[1][[m, 1, 1, 1]] = p;
    }
    kernels[2][[2, 2, 1, 1]] = 1.0;
    kernels
}

/// Returns a kernel like the paper's, which does not depend on the own state.
fn paper() -> Vec<Array4<f64>> {
    let mut kernel = Array4::zeros((3, 3, 3, 3));
    for (m, n, weight) in [
        (0, 0, 1.0),
        (1, 1, 3.0),
        (2, 1, 0.5),
        (2, 2, 0.6),
        (0, 2, 0.1),
    ] {
        kernel.slice_mut(s![m, n, .., ..]).fill(0.1 * weight);
        kernel[[m, n, 1, 1]] = weight;
    }
    vec![kernel]
}

#[test]
fn each_kind_is_closer_to_the_exact_filter_than_the_one_before() {
    // Bounds are 10% above the measured values. Without own-state kernels there are no cavities.
    for (kernels, bias, dim, one_in, n_worlds, bounds) in [
        (fire(), [0.0; 3], (2, 3), 0, 1, [0.134, 0.098, 0.076]),
        (fire(), [0.0; 3], (2, 3), 5, 40, [0.170, 0.128, 0.082]),
        (fire(), [0.0; 3], (2, 3), 1, 40, [0.0034, 0.0022, 0.0021]),
        (fire(), [0.0; 3], (3, 3), 0, 1, [0.171, 0.120, 0.089]),
        (paper(), BIAS, (2, 3), 0, 1, [0.634, 0.116, 0.116]),
        (paper(), BIAS, (2, 3), 5, 40, [0.637, 0.136, 0.136]),
        (paper(), BIAS, (2, 3), 1, 40, [0.0325, 0.0062, 0.0062]),
        (paper(), BIAS, (3, 3), 0, 1, [0.664, 0.130, 0.130]),
    ] {
        let weights = weights(&kernels, &bias);
        let off = divergences(weights, shape(dim.0, dim.1), one_in, n_worlds);
        let is_own = kernels.len() > 1;
        assert!(off[0] > off[1] && off[1] >= off[2], "{dim:?} {off:?}");
        assert_eq!(off[1] > off[2], is_own, "{dim:?} one in {one_in}: {off:?}");
        let within = off.iter().zip(bounds).all(|(off, bound)| *off < bound);
        assert!(within, "{dim:?} one in {one_in}: {off:?}");
    }
}

const BIAS: [f64; 3] = [0.01, 0.001, 0.001];

#[test]
fn cavities_sum_to_one_with_several_own_state_kernels() {
    // Own-state kernels that resemble learned ones: neighbours influence a cell in every own state, and in state 1 the
    // most.
    let kernel = |own: usize| {
        Array4::from_shape_fn((3, 3, 3, 3), |(m, n, row, col)| {
            let scale = if own == 1 { 1.0 } else { 0.05 };
            let centre = if (row, col) == (1, 1) { 1.0 } else { 0.0 };
            let at = ((own * 3 + m) * 3 + n) * 9 + row * 3 + col;
            0.01 + scale * random(9, at) + centre
        })
    };
    let kernels: Vec<_> = (0..3).map(kernel).collect();
    let weights = weights(&kernels, &[0.0; 3]);
    let mut belief = belief(3, shape(4, 35));
    let mut prediction = Prediction::new(weights, PredictionKind::Cavities, &belief);
    assert_eq!(prediction.susceptible, Some(1), "not the last own state");
    for _ in 0..4 {
        predict(&mut prediction, &mut belief);
        let length = prediction.beliefs.planes.length;
        for planes in prediction.beliefs.probabilities.chunks_exact(3 * length) {
            for at in [[0, 0], [2, 17], [3, 34]] {
                let place = prediction.beliefs.planes.place(at);
                let sum: f32 = planes[place..].iter().step_by(length).sum();
                assert!((sum - 1.0).abs() < 1e-4, "{at:?}: {sum}");
            }
        }
    }
}

#[test]
fn a_correction_changes_only_the_cavities_of_its_cells() {
    let kernels = fire();
    let states = Grid::from_shape_vec((1, 5), vec![1, 0, 0, 0, 0]).expect("a grid");
    let mut belief = Belief::from_states(&states, 3).expect("states");
    let weights = weights(&kernels, &[0.0; 3]);
    let mut prediction = Prediction::new(weights, PredictionKind::Cavities, &belief);
    predict(&mut prediction, &mut belief);
    let cavities = prediction.beliefs.probabilities.clone();
    let (before, mut after) = (belief.as_slice().to_vec(), belief.as_slice().to_vec());
    (0..3).for_each(|state| after[state * 5] = [0.1, 0.8, 0.1][state]);
    prediction.correct(&before, &after);
    let beliefs = &prediction.beliefs;
    for first in (0..cavities.len()).step_by(beliefs.planes.length) {
        for col in 1..5 {
            let place = first + beliefs.planes.place([0, col]);
            assert_eq!(beliefs.probabilities[place], cavities[place], "{col}");
        }
    }
}

#[test]
fn beliefs_about_unseen_cells_keep_summing_to_one() {
    // The rounded probabilities of this model's fixed transitions do not sum to 1.
    let model = Model::built_in("wildfire-burnout").expect("built in");
    let mut belief = belief(model.n_states(), shape(3, 5));
    let mut prediction = Prediction::new((&model).into(), PredictionKind::Cavities, &belief);
    for _ in 0..20_000 {
        predict(&mut prediction, &mut belief);
    }
    assert!(prediction.clone().restore(&prediction.to_bytes()));
    let sums = belief.view().sum_axis(Axis(0));
    assert!(sums.iter().all(|sum| (sum - 1.0).abs() < 3e-5), "{sums}");
}

#[test]
fn only_valid_cavities_are_restored() {
    let kernels = fire();
    let weights = Weights {
        edge: Some(2),
        ..weights(&kernels, &[0.0; 3])
    };
    let mut first_belief = belief(3, shape(3, 35));
    let new = |kind| Prediction::new(weights, kind, &Belief::uniform(3, shape(3, 35)));
    let (mut first, mut second) = (new(PredictionKind::Cavities), new(PredictionKind::Cavities));
    predict(&mut first, &mut first_belief);
    let (bytes, unchanged) = (first.to_bytes(), second.beliefs.probabilities.clone());
    // Eight cavities per cell, each with three `f32`.
    assert_eq!(bytes.len(), 4 * 8 * 3 * 3 * 35);
    let with = |number: usize, p: f32| {
        let mut bytes = bytes.clone();
        bytes[4 * number..][..4].copy_from_slice(&p.to_le_bytes());
        bytes
    };
    let last = bytes.len() / 4 - 1;
    for (name, refused) in [
        ("nothing", Vec::new()),
        ("a value too few", bytes[4..].to_vec()),
        ("a byte too many", [&bytes[..], &[0]].concat()),
        ("zeros", vec![0; bytes.len()]),
        ("a sum above 1", with(0, 1.0005)),
        ("a negative number", with(last, -0.5)),
        ("not a number", with(last, f32::NAN)),
    ] {
        assert!(!second.restore(&refused), "{name}");
        assert_eq!(second.beliefs.probabilities, unchanged, "{name}");
    }
    assert!(second.restore(&bytes));
    let mut second_belief = first_belief.clone();
    predict(&mut first, &mut first_belief);
    predict(&mut second, &mut second_belief);
    assert_eq!(second_belief, first_belief);
    assert_eq!(second.to_bytes(), first.to_bytes());
    let mut other = new(PredictionKind::SecondOrder);
    assert_eq!((other.n_bytes(), other.to_bytes().len()), (0, 0));
    assert!(other.restore(&[]) && !other.restore(&bytes));
}
