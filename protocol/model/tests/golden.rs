//! Comparison with vectors made by the authors' unmodified PyTorch code (`tests/data`): the operator `Phi`, the
//! observation matrix, the reward and flown paths.

use emberwatch_model::path::fly;
use emberwatch_model::{Cell, Model, Move, Shape, Transition};
use ndarray::{Array1, Array2, Array3, Array4, ArrayD, OwnedRepr};
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
    file.by_name(name).expect("an array of the requested type")
}

#[test]
fn the_wildfire_is_the_authors() {
    let model = Model::wildfire();
    // The authors' kernel is f32, so the kernels are equal only up to rounding.
    let reference: Array4<f32> = array(&mut npz("a1_transition.npz"), "kernel");
    let ratio = model.ratio().expect("a kernel");
    for (ours, theirs) in ratio.kernel().iter().zip(&reference) {
        let bound = 1.2e-7 * ours.abs();
        assert!(
            (ours - f64::from(*theirs)).abs() <= bound,
            "{ours} {theirs}"
        );
    }
    let json: serde_json::Value =
        serde_json::from_str(include_str!("data/a2_observation.json")).expect("JSON");
    let rows = json["P_obs_given_state_rows_state"].clone();
    let rows: Vec<Vec<f64>> = serde_json::from_value(rows).expect("a matrix");
    assert_eq!(model.likelihood().dim(), (rows.len(), rows[0].len()));
    for (ours, theirs) in model.likelihood().iter().zip(rows.concat()) {
        assert!((ours - theirs).abs() < 1e-7, "{ours} {theirs}");
    }
    assert_eq!(model.initial().to_vec(), [0.99, 0.01, 0.0]);
    assert_eq!(model.target_state(), 2);
}

#[test]
fn phi_matches_the_reference_on_states_and_beliefs() {
    let mut file = npz("a1_transition.npz");
    let model = Model::wildfire();
    let ratio = model.ratio().expect("a kernel");
    for size in ["1x1", "2x2", "3x3", "5x5", "4x7", "1x6", "64x64"] {
        let states: Array2<u8> = array(&mut file, &format!("{size}_state"));
        let belief: Array3<f32> = array(&mut file, &format!("{size}_prob"));
        let (_, height, width) = belief.dim();
        let known = Array3::from_shape_fn(belief.dim(), |(state, row, col)| {
            f32::from(u8::from(usize::from(states[[row, col]]) == state))
        });
        let shape = Shape::new(height, width).expect("test shape");
        let mut phi = Transition::new(ratio.kernel(), &ratio.bias().to_vec(), None, shape);
        for (input, name) in [(known, "state"), (belief, "prob")] {
            let expected: Array3<f32> = array(&mut file, &format!("{size}_phi_{name}"));
            let mut out = Array3::zeros(input.dim());
            phi.apply(&input, &mut out);
            let mut off = (out - expected).into_iter();
            assert!(off.all(|it: f32| it.abs() < 1e-6), "{size}_phi_{name}");
        }
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
        let of_cell = |(&state, &visited)| model.reward()[usize::from(state)] * f64::from(visited);
        let reward: f64 = states.iter().zip(&mask).map(of_cell).sum();
        assert_eq!(Some(&reward), expected.first(), "{size}");
    }
}

#[test]
fn a_flown_path_covers_the_reference_mask() {
    let mut file = npz("a5_planner.npz");
    let action_set: Array2<i64> = array(&mut file, "rw_action_set");
    let move_of = |&action: &u8| match action_set.row(action.into()).to_vec()[..] {
        [-1, 0] => Move::Up,
        [1, 0] => Move::Down,
        [0, -1] => Move::Left,
        [0, 1] => Move::Right,
        ref other => panic!("{other:?} is no move"),
    };
    let cell = |at: &[f64]| Cell {
        row: at[0] as usize,
        col: at[1] as usize,
    };
    for case in ["rw_6x6", "rw_6x6b", "rw_64x64"] {
        let actions: Array1<u8> = array(&mut file, &format!("{case}_moves"));
        let path: Vec<Move> = actions.iter().map(move_of).collect();
        let start: Array1<i64> = array(&mut file, &format!("{case}_start"));
        let mask: Array2<u8> = array(&mut file, &format!("{case}_mask"));
        let end: Array1<f64> = array(&mut file, &format!("{case}_end"));
        let shape = Shape::new(mask.nrows(), mask.ncols()).expect("test shape");
        let flight = fly(shape, cell(&start.mapv(|it| it as f64).to_vec()), &path);
        let mut visited = Array2::zeros(mask.dim());
        for index in flight.visited {
            visited[[index / mask.ncols(), index % mask.ncols()]] = 1;
        }
        assert_eq!(visited, mask, "{case}");
        assert_eq!(flight.end, cell(&end.to_vec()), "{case}");
    }
}
