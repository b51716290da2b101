//! Compares `Phi` on beliefs with its formula for random models and grids.

use super::models::{
    formula, random_belief, random_land, random_model, random_own_model, shape, with_edge,
};
use emberwatch_model::{Model, Transition};
use ndarray::{Array3, Axis, NdFloat};
use proptest::prelude::*;

/// Returns `Phi` of a belief, computed by an operator that was applied to another belief before.
fn predicted<T: NdFloat>(model: &Model, belief: &Array3<T>) -> Array3<T> {
    let (_, height, width) = belief.dim();
    let mut out = Array3::ones(belief.dim());
    let mut transition = Transition::new(model, shape(height, width)).expect("test model");
    let mut other = Array3::zeros(belief.dim());
    other.index_axis_mut(Axis(0), 0).fill(T::one());
    transition.apply(&other, &mut out);
    transition.apply(belief, &mut out);
    out
}

fn assert_close(got: &Array3<f64>, expected: &Array3<f64>, bound: f64) {
    let differences = got - expected;
    assert!(differences.iter().all(|it| it.abs() < bound));
}

proptest! {
    // Failures are not written to a file, because tests must not change the source tree.
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..Default::default() })]

    #[test]
    fn predictions_are_those_of_the_formula(
        key in 0_u64..1_000_000,
        n_states in 2_usize..7,
        half_kernel in (0_usize..4, 0_usize..4),
        n_zones in prop_oneof![Just(0), 1_u64..6],
        (sees_own, has_edge) in any::<(bool, bool)>(),
        side in (1_usize..12, 1_usize..70),
    ) {
        let kernel_size = [2 * half_kernel.0 + 1, 2 * half_kernel.1 + 1];
        let random = if sees_own { random_own_model } else { random_model };
        let of_zone = |zone| random(key + 1000 * zone, n_states, kernel_size);
        let models: Vec<Model> = (0..n_zones.max(1)).map(of_zone).collect();
        let land = if n_zones == 0 { models[0].clone() } else { random_land(key, &models, side) };
        let model = if has_edge { with_edge(&land, key) } else { land };
        let belief = random_belief(key, n_states, side);
        let expected = formula(&model, &belief);
        assert_close(&predicted(&model, &belief), &expected, 1e-12);
        let single = predicted(&model, &belief.mapv(|p| p as f32));
        prop_assert!(single.iter().all(|&p| (0.0..=1.0 + 1e-6).contains(&p)));
        let mut sums = single.sum_axis(Axis(0)).into_iter();
        prop_assert!(sums.all(|sum| (sum - 1.0).abs() < 1e-6));
        assert_close(&single.mapv(f64::from), &expected, 2e-6);
    }
}

#[test]
fn a_prediction_is_that_of_the_python_filter() {
    let json: serde_json::Value =
        serde_json::from_str(include_str!("../data/own_state.json")).expect("JSON");
    let array = |key: &str| {
        let numbers = serde_json::from_value::<Vec<Vec<Vec<f64>>>>(json[key].clone());
        let numbers = numbers.expect("numbers").concat().concat();
        Array3::from_shape_vec((3, 4, 5), numbers).expect("3 x 4 x 5 numbers")
    };
    let model = Model::built_in("wildfire-burnout").expect("built in");
    let (belief, expected) = (array("belief"), array("prediction"));
    assert_close(&predicted(&model, &belief), &expected, 1e-12);
}
