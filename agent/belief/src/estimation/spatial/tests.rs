//! Tests of the spatial filter. The test vectors come from an independent implementation (NumPy, 64-bit) with a given
//! table of correlations:
//!
//! ```python
//! np.savez(name, table=table, cells=cells, obs=obs, first_predictor=u_1, post=posteriors[2::3])  # 32 bits
//! ```
//!
//! The cells of each path are listed in order of the first visit, and shorter lists are padded with -1.

use super::*;
use crate::estimation::correlations::N_AGES;
use emberwatch_model::randomness::split_mix;
use emberwatch_model::{Cell, Model, ModelFile, Shape};
use ndarray::{Array2, Array3, Array4, Axis};
use ndarray_npy::NpzReader;
use proptest::prelude::*;
use std::fs::File;

const FIRE: usize = 2;

/// Returns the wildfire model after a change to its model file.
fn wildfire(change: impl FnOnce(&mut ModelFile)) -> Model {
    let mut file = Model::wildfire().file().clone();
    change(&mut file);
    Model::new(file).expect("a model")
}

fn shape(height: usize, width: usize) -> Shape {
    Shape::new(height, width).expect("a grid")
}

#[test]
fn corrections_agree_with_an_independent_implementation() {
    for side in [16, 64] {
        let root = env!("CARGO_MANIFEST_DIR");
        let path = format!("{root}/tests/data/spatial_{side}.npz");
        let mut npz = NpzReader::new(File::open(path).expect("a file")).expect("npz");
        let table: Array4<f32> = npz.by_name("table.npy").expect("a table");
        let cells: Array2<i16> = npz.by_name("cells.npy").expect("cells");
        let observed: Array2<i8> = npz.by_name("obs.npy").expect("observations");
        let first: Array3<f32> = npz.by_name("first_predictor.npy").expect("a predictor");
        let posteriors: Array4<f32> = npz.by_name("post.npy").expect("posteriors");
        let prior = Belief::from_probabilities(first).expect("a belief");
        let filter = BayesFilter::known(&Model::wildfire(), prior, false).expect("valid");
        let mut filter = SpatialFilter::new(filter, FIRE, Correlations::of_table(&table));
        // The test vectors start after the first prediction.
        filter.ages.grow();
        for (step, (cells, seen)) in cells.outer_iter().zip(observed.outer_iter()).enumerate() {
            let seen = cells.iter().zip(seen).filter(|(cell, _)| **cell >= 0);
            let seen = seen.map(|(&cell, &value)| (cell as usize, value as u8));
            filter.correct_in_order(seen).expect("possible");
            if step % 3 == 2 {
                let off = &filter.belief().view() - &posteriors.index_axis(Axis(0), step / 3);
                let off = off.iter().fold(0.0_f32, |worst, d| worst.max(d.abs()));
                assert!(off < 1e-5, "{side}: posterior {step} is off by {off}");
            }
            filter.predict();
        }
    }
}

#[test]
fn an_impossible_frame_changes_nothing_with_or_without_spread() {
    let model = wildfire(|file| file.states[0].observed_as = vec![1.0, 0.0, 0.0]);
    let states = ndarray::arr2(&[[2, 2], [0, 2]]);
    let prior = Belief::from_states(&states, 3).expect("states");
    // The observation of cell 0 is possible. The observation of cell 2 is not: the cell is certainly normal, and this
    // model never shows a normal cell as fire.
    let frame = Frame::from_bytes(shape(2, 2), 3, &[2, 255, 2, 2]).expect("a frame");
    let with = |cavities| BayesFilter::known(&model, prior.clone(), cavities).expect("valid");
    let neighbours = Some((FIRE, Correlations::default()));
    for (cavities, neighbours) in [(false, None), (true, None), (false, neighbours)] {
        let mut filter = correcting(with(cavities), neighbours);
        let before = filter.to_bytes();
        let Err(EstimatorError::ZeroEvidence(error)) = filter.correct(&frame) else {
            panic!("expected a normal cell seen as fire");
        };
        assert_eq!((error.cell, error.observed), (Cell { row: 1, col: 0 }, 2));
        assert_eq!(filter.to_bytes(), before);
    }
}

#[test]
fn a_tiny_probability_does_not_count_as_zero() {
    let model = wildfire(|file| {
        file.states[0].observed_as = vec![1.0, 0.0, 0.0];
        file.states[FIRE].observed_as = vec![0.999, 0.0005, 0.0005];
    });
    let prior = ndarray::arr3(&[[[1.0]], [[0.0]], [[f32::MIN_POSITIVE]]]);
    let prior = Belief::from_probabilities(prior).expect("a belief");
    let filter = BayesFilter::known(&model, prior, false).expect("valid");
    for neighbours in [None, Some((FIRE, Correlations::default()))] {
        let mut filter = correcting(filter.clone(), neighbours);
        let frame = Frame::from_bytes(shape(1, 1), 3, &[2]).expect("a frame");
        filter.correct(&frame).expect("possible");
        assert_eq!(filter.belief().as_slice(), [0.0, 0.0, 1.0]);
    }
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(64) })]

    #[test]
    fn beliefs_stay_valid_and_saved_bytes_are_the_whole_state(
        (height, width) in (1_usize..12, 1_usize..12),
        frames in prop::collection::vec(prop::collection::vec(0_u8..6, 144), 1..12),
        (name, paying) in prop_oneof![(Just("wildfire"), 0_usize..3), (Just("road-ice"), 0_usize..4)],
    ) {
        let (shape, model) = (shape(height, width), Model::built_in(name).expect("built in"));
        let new = || {
            let prior = Belief::uniform(model.n_states(), shape);
            let filter = BayesFilter::known(&model, prior, false).expect("valid");
            SpatialFilter::new(filter, paying, Correlations::default())
        };
        let mut filter = new();
        for values in frames {
            let seen = values[..shape.n_cells()].iter();
            let bytes: Vec<u8> = seen.map(|&value| if value < 3 { value } else { 255 }).collect();
            let frame = Frame::from_bytes(shape, 3, &bytes).expect("a frame");
            let mut other = new();
            prop_assert!(other.restore(&filter.to_bytes()));
            for filter in [&mut filter, &mut other] {
                filter.correct(&frame).expect("possible");
                let belief = filter.belief().probabilities().clone();
                prop_assert!(Belief::from_probabilities(belief).is_ok());
                filter.predict();
            }
            prop_assert_eq!(filter.to_bytes(), other.to_bytes());
        }
        let memory = filter.to_bytes();
        prop_assert!(!filter.restore(&memory[1..]));
        prop_assert_eq!(filter.to_bytes(), memory);
    }
}

#[test]
fn only_cells_that_change_together_become_correlated() {
    let shape = shape(5, 5);
    let belief = Belief::everywhere(&[0.5, 0.17, 0.33], shape);
    let model = Model::wildfire();
    let [alike, apart] = [true, false].map(|is_alike| {
        let mut correlations = Correlations::default();
        let ages = Ages::new(shape.n_cells());
        for number in 0..100 {
            let burns = |cell| split_mix(number, if is_alike { 0 } else { cell }).is_multiple_of(3);
            let looks = (0..25).map(|cell| if burns(cell) { 2 } else { 0 });
            let frame = Frame::from_bytes(shape, 3, &looks.collect::<Vec<_>>());
            let frame = frame.expect("a frame");
            let evidence = Evidence::of(&frame, &belief, model.likelihood(), FIRE, &ages);
            correlations.learn(&evidence);
        }
        correlations
    });
    let oldest = N_AGES - 1;
    for class in 1..15 {
        assert!(alike.of(oldest)[oldest][class] > 0.7, "{class}");
        assert!(apart.of(oldest)[oldest][class] < 0.1, "{class}");
    }
}
