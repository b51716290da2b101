//! `Phi` on beliefs against its formula (paper eqs. 2-4), for any model and grid.

use super::models::{check_predictions, random_belief, random_model, shape, with_edge};
use emberwatch_model::{Model, Transition};
use ndarray::{Array3, Axis};
use proptest::prelude::*;

/// The formula of eqs. 2-4 as it stands.
fn formula(model: &Model, belief: &Array3<f64>) -> Array3<f64> {
    let (n_states, height, width) = belief.dim();
    let (.., kernel_height, kernel_width) = model.kernel().dim();
    let mut out = Array3::from_shape_fn((n_states, height, width), |(to, row, col)| {
        let mut weight = model.bias()[to];
        for from in 0..n_states {
            for (a, c) in ndarray::indices((kernel_height, kernel_width)) {
                let (i, j) = (row + a, col + c);
                let (up, left) = (kernel_height / 2, kernel_width / 2);
                let belief = if (up..height + up).contains(&i) && (left..width + left).contains(&j)
                {
                    belief[[from, i - up, j - left]]
                } else {
                    f64::from(u8::from(model.edge() == Some(from)))
                };
                weight += model.kernel()[[to, from, a, c]] * belief;
            }
        }
        weight
    });
    let sums = out.sum_axis(Axis(0));
    out /= &sums;
    out
}

proptest! {
    // No file of failures: tests leave the source tree alone.
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..Default::default() })]

    #[test]
    fn apply_equals_the_formula_and_keeps_beliefs_on_the_simplex(
        key in 0_u64..1_000_000,
        n_states in 2_usize..7,
        half_kernel in (0_usize..4, 0_usize..4),
        side in (1_usize..20, 1_usize..40),
    ) {
        let kernel_size = [2 * half_kernel.0 + 1, 2 * half_kernel.1 + 1];
        let model = random_model(key, n_states, kernel_size);
        let model = if key.is_multiple_of(2) { with_edge(&model, key) } else { model };
        let belief = random_belief(key, n_states, side);
        check_predictions(&model, &belief, &formula(&model, &belief));
    }
}

#[test]
fn apply_leaves_nothing_of_the_belief_before() {
    let beliefs = [1, 2].map(|key| random_belief(key, 3, (3, 17)));
    let mut used = Transition::new(&Model::wildfire(), shape(3, 17)).expect("wildfire");
    let mut fresh = used.clone();
    let [mut after_another, mut alone] = [Array3::zeros((3, 3, 17)), Array3::zeros((3, 3, 17))];
    used.apply(&beliefs[0], &mut after_another);
    used.apply(&beliefs[1], &mut after_another);
    fresh.apply(&beliefs[1], &mut alone);
    assert_eq!(after_another, alone);
}
