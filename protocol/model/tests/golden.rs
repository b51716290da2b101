//! Against vectors made by the authors' unmodified PyTorch code (`tests/data`): the operator `Phi`, the
//! observation matrix, the reward and flown paths.

use emberwatch_model::path::fly;
use emberwatch_model::{Cell, Model, Move, Shape, Transition};
use ndarray::{Array1, Array2, Array3, Array4, ArrayD, NdFloat, OwnedRepr, s};
use ndarray_npy::{NpzReader, ReadableElement};
use std::fs::File;

type Npz = NpzReader<File>;

fn npz(name: &str) -> Npz {
    let path = format!("{}/tests/data/{name}", env!("CARGO_MANIFEST_DIR"));
    NpzReader::new(File::open(path).expect("test data")).expect("an npz file")
}

fn array<T: ReadableElement, D: ndarray::Dimension>(
    file: &mut Npz,
    name: &str,
) -> ndarray::ArrayBase<OwnedRepr<T>, D> {
    file.by_name(name).expect("an array of the type asked for")
}

fn shape_of<T>(states: &Array2<T>) -> Shape {
    Shape::new(states.nrows(), states.ncols()).expect("test shape")
}

/// Applies `Phi` and returns the largest difference to the reference.
fn deviation<T: NdFloat>(model: &Model, belief: &Array3<T>, expected: &Array3<T>) -> T {
    let (_, height, width) = belief.dim();
    let shape = Shape::new(height, width).expect("test shape");
    let mut phi = Transition::<T>::new(model, shape).expect("wildfire runs anywhere");
    let mut out = Array3::zeros(belief.dim());
    phi.apply(belief, &mut out);
    let differences = out.iter().zip(expected).map(|(a, b)| (*a - *b).abs());
    differences.fold(T::zero(), T::max)
}

fn one_hot<T: NdFloat>(states: &Array2<u8>) -> Array3<T> {
    let (height, width) = states.dim();
    Array3::from_shape_fn((3, height, width), |(state, row, col)| {
        let here = usize::from(states[[row, col]]) == state;
        if here { T::one() } else { T::zero() }
    })
}

#[test]
fn the_kernel_is_the_authors() {
    // Theirs is f32: equal up to its rounding.
    let reference: Array4<f32> = array(&mut npz("a1_transition.npz"), "kernel");
    let model = Model::wildfire();
    for (ours, theirs) in model.kernel().iter().zip(&reference) {
        assert!(
            (ours - f64::from(*theirs)).abs() <= 1.2e-7 * ours.abs(),
            "{ours} {theirs}"
        );
    }
}

#[test]
fn phi_matches_the_reference_on_states_and_beliefs() {
    let mut file = npz("a1_transition.npz");
    let model = Model::wildfire();
    for size in ["1x1", "2x2", "3x3", "5x5", "4x7", "1x6", "64x64"] {
        let states = array(&mut file, &format!("{size}_state"));
        let expected: Array3<f32> = array(&mut file, &format!("{size}_phi_state"));
        let on_states = deviation(&model, &one_hot(&states), &expected);
        let belief: Array3<f32> = array(&mut file, &format!("{size}_prob"));
        let expected = array(&mut file, &format!("{size}_phi_prob"));
        let on_beliefs = deviation(&model, &belief, &expected);
        assert!(
            on_states < 1e-6 && on_beliefs < 1e-6,
            "{size}: {on_states} {on_beliefs}"
        );
    }
}

#[test]
fn phi_matches_the_reference_in_double_precision() {
    let mut file = npz("a1_transition.npz");
    let model = model_of(&array(&mut file, "kernel"));
    for size in ["1x1", "2x2", "3x3", "5x5", "4x7", "1x6"] {
        let states = array(&mut file, &format!("{size}_state"));
        let expected: Array3<f64> = array(&mut file, &format!("{size}_phi_state_f64"));
        let on_states = deviation(&model, &one_hot(&states), &expected);
        let belief: Array3<f32> = array(&mut file, &format!("{size}_prob"));
        let expected: Array3<f64> = array(&mut file, &format!("{size}_phi_prob_f64"));
        let on_beliefs = deviation(&model, &belief.mapv(f64::from), &expected);
        assert!(
            on_states < 1e-12 && on_beliefs < 1e-12,
            "{size}: {on_states} {on_beliefs}"
        );
    }
}

/// The wildfire model with the reference's own kernel: its double-precision runs convert the kernel
/// from f32, which the exact parameters miss by 6e-9.
fn model_of(kernel: &Array4<f32>) -> Model {
    let mut file = Model::wildfire().file().clone();
    for entry in &mut file.kernel {
        let state = |name: &str| Model::wildfire().state_named(name).expect("a state");
        let block = kernel.slice(s![state(&entry.to), state(&entry.from), .., ..]);
        let rows = block.outer_iter();
        entry.weights = rows
            .map(|row| row.iter().map(|&w| w.into()).collect())
            .collect();
        entry.scale = 1.0;
    }
    Model::new(file).expect("the reference's kernel is valid")
}

#[test]
fn the_observation_matrix_is_the_authors() {
    let text = std::fs::read_to_string(concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/tests/data/a2_observation.json"
    ));
    let json: serde_json::Value = serde_json::from_str(&text.expect("test data")).expect("JSON");
    let rows: Vec<Vec<f64>> =
        serde_json::from_value(json["P_obs_given_state_rows_state"].clone()).expect("a matrix");
    let model = Model::wildfire();
    assert_eq!(model.likelihood().dim(), (rows.len(), rows[0].len()));
    for (ours, theirs) in model.likelihood().iter().zip(rows.concat()) {
        assert!((ours - theirs).abs() < 1e-7, "{ours} {theirs}");
    }
}

#[test]
fn the_reward_counts_visited_cells_on_fire() {
    let mut file = npz("a6_reward.npz");
    let model = Model::wildfire();
    for size in ["6x6", "64x64"] {
        let states: Array2<u8> = array(&mut file, &format!("{size}_state"));
        let mask: Array2<u8> = array(&mut file, &format!("{size}_mask"));
        let expected: ArrayD<f64> = array(&mut file, &format!("{size}_reward"));
        let visited = states
            .iter()
            .zip(&mask)
            .filter(|&(_, &visited)| visited == 1);
        let reward: f64 = visited.map(|(&s, _)| model.reward()[usize::from(s)]).sum();
        assert_eq!(Some(&reward), expected.first(), "{size}");
    }
}

#[test]
fn a_flown_path_covers_the_reference_mask() {
    let mut file = npz("a5_planner.npz");
    let action_set: Array2<i64> = array(&mut file, "rw_action_set");
    let action_set: Vec<Move> = action_set
        .outer_iter()
        .map(|a| move_of(a[0], a[1]))
        .collect();
    for case in ["rw_6x6", "rw_6x6b", "rw_64x64"] {
        let actions: Array1<u8> = array(&mut file, &format!("{case}_moves"));
        let path: Vec<Move> = actions
            .iter()
            .map(|&a| action_set[usize::from(a)])
            .collect();
        let start: Array1<i64> = array(&mut file, &format!("{case}_start"));
        let mask: Array2<u8> = array(&mut file, &format!("{case}_mask"));
        let end: Array1<f64> = array(&mut file, &format!("{case}_end"));
        let flight = fly(
            shape_of(&mask),
            cell(start[0] as f64, start[1] as f64),
            &path,
        );
        let mut visited = Array2::zeros(mask.dim());
        for index in flight.visited {
            visited[[index / mask.ncols(), index % mask.ncols()]] = 1;
        }
        assert_eq!(visited, mask, "{case}");
        assert_eq!(flight.end, cell(end[0], end[1]), "{case}");
    }
}

fn cell(row: f64, col: f64) -> Cell {
    let (row, col) = (row as usize, col as usize);
    Cell { row, col }
}

/// The reference's random walk moves `[row, col]` by an entry of its action set.
fn move_of(row: i64, col: i64) -> Move {
    match (row, col) {
        (-1, 0) => Move::Up,
        (1, 0) => Move::Down,
        (0, -1) => Move::Left,
        (0, 1) => Move::Right,
        other => panic!("{other:?} is no move"),
    }
}
