//! Vectors of an independent implementation (numpy, 64 bits), which spreads with a given table:
//!
//! ```python
//! np.savez(name, table=table, cells=cells, obs=obs, first_predictor=u_1, post=posteriors, pred=predictors)
//! ```
//!
//! Cells are in order of their first visit, -1 where a path visits fewer.

use super::*;
use ndarray::{Array2, Array3, Array4, ArrayView3, Axis};
use ndarray_npy::NpzReader;
use proptest::prelude::*;
use protocol::Model;
use std::fs::File;

const FIRE: usize = 2;

fn wildfire(prior: Belief, correlations: Correlations) -> SpatialFilter {
    let filter = BayesFilter::known(&Model::wildfire(), prior).expect("valid");
    SpatialFilter::new(filter, FIRE, correlations)
}

fn worst(belief: &Belief, expected: ArrayView3<'_, f64>) -> f64 {
    let differences = belief.view().mapv(f64::from) - expected;
    differences.iter().fold(0.0, |worst, d| worst.max(d.abs()))
}

fn numbers(npz: &mut NpzReader<File>, name: &str) -> Array4<f64> {
    let name = format!("{name}.npy");
    match npz.by_name::<ndarray::OwnedRepr<f64>, _>(&name) {
        Ok(numbers) => numbers,
        Err(_) => {
            let numbers: Array4<f32> = npz.by_name(&name).expect("numbers");
            numbers.mapv(f64::from)
        }
    }
}

fn check_golden(side: usize) {
    let path = format!(
        "{}/tests/data/spatial_{side}.npz",
        env!("CARGO_MANIFEST_DIR")
    );
    let mut npz = NpzReader::new(File::open(path).expect("a file")).expect("npz");
    let table = numbers(&mut npz, "table");
    let cells: Array2<i16> = npz.by_name("cells.npy").expect("cells");
    let observed: Array2<i8> = npz.by_name("obs.npy").expect("observations");
    let first: Array3<f64> = npz.by_name("first_predictor.npy").expect("a predictor");
    let (posteriors, predictors) = (numbers(&mut npz, "post"), numbers(&mut npz, "pred"));
    let prior = Belief::from_probabilities(first.mapv(|p| p as f32)).expect("a belief");
    let mut filter = wildfire(prior, Correlations::of_table(&table));
    // The first prediction was made already.
    filter.ages.grow();
    for (step, (cells, observed)) in cells.outer_iter().zip(observed.outer_iter()).enumerate() {
        let seen = cells.iter().zip(observed).filter(|(cell, _)| **cell >= 0);
        let seen = seen.map(|(&cell, &value)| (cell as usize, value as u8));
        filter.correct_in_order(seen).expect("possible");
        let off = worst(filter.belief(), posteriors.index_axis(Axis(0), step));
        assert!(off < 1e-5, "{side}: posterior {step} is off by {off}");
        filter.predict();
        let off = worst(filter.belief(), predictors.index_axis(Axis(0), step));
        assert!(off < 1e-5, "{side}: predictor {step} is off by {off}");
    }
}

#[test]
fn corrections_are_those_of_an_independent_implementation() {
    check_golden(16);
    check_golden(64);
}
