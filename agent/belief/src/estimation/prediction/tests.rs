mod exact;

use super::*;
use emberwatch_model::randomness::split_mix;
use emberwatch_model::transition::Transition;
use emberwatch_model::{Grid, Model};
use exact::divergence;
use ndarray::Array4;

fn belief(n_states: usize, shape: Shape, seed: u64) -> Belief {
    let number = |at: usize| (split_mix(seed, at as u64) >> 40) as f32 / (1 << 24) as f32;
    let (height, width) = shape.dim();
    let mut numbers = emberwatch_model::grid::Probabilities::from_shape_fn(
        (n_states, height, width),
        |(state, row, col)| number((state * 100 + row) * 100 + col) + 0.01,
    );
    for row in 0..height {
        for col in 0..width {
            let mut cell = numbers.slice_mut(ndarray::s![.., row, col]);
            let total = cell.sum();
            cell.mapv_inplace(|p| p / total);
        }
    }
    Belief::from_probabilities(numbers).expect("a belief")
}

fn predict(prediction: &mut Prediction, belief: &mut Belief) {
    let before = belief.as_slice().to_vec();
    prediction.predict(&before, belief.as_mut_slice());
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
            Some(map) => Shape::new(map.nrows(), map.ncols()).expect("shape"),
            None => Shape::new(9, 37).expect("shape"),
        };
        let mut got = belief(model.n_states(), shape, 3);
        let mut transition = Transition::new(&model, shape).expect("a transition");
        let mut expected = got.probabilities().clone();
        transition.apply(got.probabilities(), &mut expected);
        let mut prediction = Prediction::new((&model).into(), PredictionKind::MeanField, &got);
        predict(&mut prediction, &mut got);
        let pairs = got.probabilities().iter().zip(&expected);
        let off = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(off < 2e-6, "{name}: {off}");
    }
}

/// A belief with a frame of cells around it that are certainly in state 1.
fn framed(inner: &Belief) -> Belief {
    let (height, width) = inner.shape().dim();
    let mut framed = ndarray::Array3::zeros((inner.n_states(), height + 2, width + 2));
    framed.index_axis_mut(ndarray::Axis(0), 1).fill(1.0);
    let cells = ndarray::s![.., 1..=height, 1..=width];
    framed.slice_mut(cells).assign(&inner.view());
    Belief::from_probabilities(framed).expect("a belief")
}

#[test]
fn an_edge_is_a_frame_of_cells_in_its_state() {
    let (kernels, bias) = (fire(), [0.0; 3]);
    let weights = weights(&kernels, &bias);
    let with_edge = Weights {
        edge: Some(1),
        ..weights
    };
    for kind in KINDS {
        let mut got = belief(3, Shape::new(5, 7).expect("shape"), 3);
        let mut expected = framed(&got);
        let mut prediction = Prediction::new(with_edge, kind, &got);
        let mut of_frame = Prediction::new(weights, kind, &expected);
        for step in 0..4 {
            predict(&mut prediction, &mut got);
            predict(&mut of_frame, &mut expected);
            let inner = expected.view();
            let inner = inner.slice(ndarray::s![.., 1..6, 1..8]);
            let off = (&got.view() - &inner).mapv(f32::abs);
            let off = off.fold(0.0, |a: f32, b| a.max(*b));
            assert!(off < 2e-6, "{kind:?}, step {step}: {off}");
            let reset = framed(&got);
            of_frame.correct(expected.as_slice(), reset.as_slice());
            expected = reset;
        }
    }
}

#[test]
fn weights_of_any_size_predict_alike() {
    for exponent in [-300, 300] {
        let scale = 2.0_f64.powi(exponent);
        let scaled: Vec<_> = fire().iter().map(|kernel| kernel * scale).collect();
        let (kernels, bias) = (fire(), [0.0; 3]);
        for kind in [PredictionKind::SecondOrder, PredictionKind::Cavities] {
            let mut expected = belief(3, Shape::new(4, 5).expect("shape"), 3);
            let mut got = expected.clone();
            let mut prediction = Prediction::new(weights(&kernels, &bias), kind, &expected);
            predict(&mut prediction, &mut expected);
            predict(
                &mut Prediction::new(weights(&scaled, &bias), kind, &got),
                &mut got,
            );
            assert_eq!(
                got.as_slice(),
                expected.as_slice(),
                "{kind:?}, 2^{exponent}"
            );
        }
    }
}

/// The weights of a grid without zones or an edge state.
fn weights<'a>(kernels: &'a [Array4<f64>], bias: &'a [f64]) -> Weights<'a> {
    Weights {
        kernels,
        bias,
        zones: (None, 1),
        edge: None,
    }
}

/// A fire: a cell with `f` burning neighbours of four ignites with probability `f / (a f + b)`, and burns out with 0.1.
fn fire() -> Vec<Array4<f64>> {
    let (a, b) = (0.7, 1.8);
    let mut kernels = vec![Array4::zeros((3, 3, 3, 3)); 3];
    for (row, col) in [(0, 1), (1, 0), (1, 2), (2, 1)] {
        kernels[0][[1, 1, row, col]] = 1.0;
        for n in [0, 2] {
            kernels[0][[0, n, row, col]] = 1.0 - a;
        }
    }
    // The centre makes up for the weights of neighbours that do not burn.
    kernels[0][[0, 0, 1, 1]] = b - 4.0 * (1.0 - a);
    for (m, p) in [(1, 0.9), (2, 0.1)] {
        kernels[1][[m, 1, 1, 1]] = p;
    }
    kernels[2][[2, 2, 1, 1]] = 1.0;
    kernels
}

const KINDS: [PredictionKind; 3] = [
    PredictionKind::MeanField,
    PredictionKind::SecondOrder,
    PredictionKind::Cavities,
];

#[test]
fn each_kind_is_closer_to_the_exact_filter_than_the_one_before() {
    let (kernels, bias) = (fire(), [0.0; 3]);
    let weights = weights(&kernels, &bias);
    // Bounds: a tenth above measured values.
    for ([height, width], one_in, n_worlds, bounds) in [
        ([2, 3], 0, 1, [0.134, 0.098, 0.076]),
        ([2, 3], 5, 40, [0.170, 0.128, 0.082]),
        ([2, 3], 1, 40, [0.0034, 0.0022, 0.0021]),
        ([3, 3], 0, 1, [0.171, 0.120, 0.089]),
    ] {
        let shape = Shape::new(height, width).expect("shape");
        let off = KINDS.map(|kind| divergence((weights, 1), shape, kind, (one_in, n_worlds)));
        assert!(off.is_sorted_by(|a, b| a > b), "one in {one_in}: {off:?}");
        let within = off.iter().zip(bounds).all(|(off, bound)| *off < bound);
        assert!(within, "one in {one_in}: {off:?}");
    }
}

/// The paper's kernels do not depend on the own state.
#[test]
fn the_second_order_is_closer_for_the_papers_kernels() {
    let mut kernel = Array4::zeros((3, 3, 3, 3));
    for (row, col) in (0..9).map(|tap| (tap / 3, tap % 3)) {
        let near = if (row, col) == (1, 1) { 1.0 } else { 0.1 };
        for (m, n, weight) in [
            (0, 0, 1.0),
            (1, 1, 3.0),
            (2, 1, 0.5),
            (2, 2, 0.6),
            (0, 2, 0.1),
        ] {
            kernel[[m, n, row, col]] = near * weight;
        }
    }
    let (kernels, bias) = ([kernel], [0.01, 0.001, 0.001]);
    let weights = weights(&kernels, &bias);
    // Bounds: a tenth above measured values.
    for ([height, width], one_in, n_worlds, bounds) in [
        ([2, 3], 0, 1, [0.634, 0.116]),
        ([2, 3], 5, 40, [0.637, 0.136]),
        ([2, 3], 1, 40, [0.0325, 0.0062]),
        ([3, 3], 0, 1, [0.664, 0.130]),
    ] {
        let shape = Shape::new(height, width).expect("shape");
        let off = KINDS.map(|kind| divergence((weights, 1), shape, kind, (one_in, n_worlds)));
        assert!(off[0] > 2.0 * off[1], "one in {one_in}: {off:?}");
        assert!(
            off[0] < bounds[0] && off[1] < bounds[1],
            "one in {one_in}: {off:?}"
        );
        assert_eq!(off[1], off[2], "no cavities without own kernels");
    }
}

/// Own-state kernels like learned ones: neighbours influence each own state, and state 1 most.
fn learned_like() -> Vec<Array4<f64>> {
    let kernel = |own: usize| {
        Array4::from_shape_fn((3, 3, 3, 3), |(m, n, row, col)| {
            let number =
                (split_mix(9, (((own * 3 + m) * 3 + n) * 9 + row * 3 + col) as u64) >> 40) as f64;
            let scale = if own == 1 { 1.0 } else { 0.05 };
            let centre = if (row, col) == (1, 1) { 1.0 } else { 0.0 };
            0.01 + scale * number / (1 << 24) as f64 + centre
        })
    };
    (0..3).map(kernel).collect()
}

#[test]
fn cavities_stay_distributions_where_several_own_states_act() {
    let (kernels, bias) = (learned_like(), [0.0; 3]);
    let weights = weights(&kernels, &bias);
    let shape = Shape::new(4, 35).expect("shape");
    let mut belief = belief(3, shape, 3);
    let mut prediction = Prediction::new(weights, PredictionKind::Cavities, &belief);
    assert_eq!(prediction.susceptible, Some(1), "not the last own state");
    for _ in 0..4 {
        predict(&mut prediction, &mut belief);
        for cavity in 0..prediction.offsets.len() {
            for (row, col) in [(0, 0), (2, 17), (3, 34)] {
                let place = prediction.beliefs.planes.place([row, col]);
                let plane = |state| (cavity * 3 + state) * prediction.beliefs.planes.length + place;
                let sum: f32 = (0..3)
                    .map(|state| prediction.beliefs.probabilities[plane(state)])
                    .sum();
                assert!((sum - 1.0).abs() < 1e-4, "{cavity} ({row}, {col}): {sum}");
            }
        }
    }
}

#[test]
fn a_correction_changes_the_cavities_of_its_cells_alone() {
    let (kernels, bias) = (fire(), [0.0; 3]);
    let weights = weights(&kernels, &bias);
    let states = Grid::from_shape_vec((1, 5), vec![1, 0, 0, 0, 0]).expect("a grid");
    let mut belief = Belief::from_states(&states, 3).expect("states");
    let mut prediction = Prediction::new(weights, PredictionKind::Cavities, &belief);
    predict(&mut prediction, &mut belief);
    let (before, cavities) = (
        belief.as_slice().to_vec(),
        prediction.beliefs.probabilities.clone(),
    );
    let mut after = before.clone();
    (0..3).for_each(|state| after[state * 5] = [0.1, 0.8, 0.1][state]);
    prediction.correct(&before, &after);
    let planes = prediction
        .beliefs
        .probabilities
        .chunks_exact(prediction.beliefs.planes.length);
    for (new, old) in planes.zip(cavities.chunks_exact(prediction.beliefs.planes.length)) {
        for col in 1..5 {
            let place = prediction.beliefs.planes.place([0, col]);
            assert_eq!(new[place], old[place], "column {col}");
        }
    }
}

#[test]
fn unseen_cells_stay_distributions_for_ever() {
    // The rounded probabilities of its fixed transitions do not sum to 1.
    let model = Model::built_in("wildfire-burnout").expect("built in");
    let mut belief = belief(model.n_states(), Shape::new(3, 5).expect("shape"), 3);
    let mut prediction = Prediction::new((&model).into(), PredictionKind::Cavities, &belief);
    for _ in 0..20_000 {
        predict(&mut prediction, &mut belief);
    }
    assert!(prediction.clone().restore(&prediction.to_bytes()));
    let sums = belief.view().sum_axis(ndarray::Axis(0));
    assert!(sums.iter().all(|sum| (sum - 1.0).abs() < 3e-5));
}

#[test]
fn only_bytes_of_cavities_are_restored() {
    let (kernels, bias) = (fire(), [0.0; 3]);
    let weights = Weights {
        edge: Some(2),
        ..weights(&kernels, &bias)
    };
    let shape = Shape::new(3, 35).expect("shape");
    let mut first_belief = belief(3, shape, 3);
    let new = |kind| Prediction::new(weights, kind, &belief(3, shape, 4));
    let (mut first, mut second) = (new(PredictionKind::Cavities), new(PredictionKind::Cavities));
    predict(&mut first, &mut first_belief);
    let (bytes, unchanged) = (first.to_bytes(), second.beliefs.probabilities.clone());
    // Eight neighbours.
    assert_eq!(bytes.len(), 4 * 8 * 3 * 3 * 35);
    let with = |number: usize, p: f32| {
        let mut bytes = bytes.clone();
        bytes[4 * number..][..4].copy_from_slice(&p.to_le_bytes());
        bytes
    };
    let last = bytes.len() / 4 - 1;
    for (name, refused) in [
        ("nothing", Vec::new()),
        ("a number too few", bytes[4..].to_vec()),
        ("a byte too many", [&bytes[..], &[0]].concat()),
        ("zeros", vec![0; bytes.len()]),
        ("a sum over one", with(0, 1.0005)),
        ("a negative number", with(last, -0.5)),
        ("no number", with(last, f32::NAN)),
    ] {
        assert!(!second.restore(&refused), "{name}");
        assert_eq!(second.beliefs.probabilities, unchanged, "{name}");
    }
    assert!(second.restore(&bytes));
    let mut second_belief = first_belief.clone();
    predict(&mut first, &mut first_belief);
    predict(&mut second, &mut second_belief);
    assert_eq!(
        (first_belief, first.to_bytes()),
        (second_belief, second.to_bytes())
    );
    let mut second_order = new(PredictionKind::SecondOrder);
    assert_eq!(
        (second_order.n_bytes(), second_order.to_bytes().len()),
        (0, 0)
    );
    assert!(second_order.restore(&[]) && !second_order.restore(&bytes));
}
