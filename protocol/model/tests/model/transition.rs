//! Compares `Phi` on beliefs with its formula for random models and grids.

use super::models::{formula, random_belief, random_model, shape, with_edge};
use emberwatch_model::{Model, Probabilities, Transition};
use ndarray::{Array3, Axis};
use proptest::prelude::*;

/// Returns `Phi` of a belief, computed by an operator that was applied to another belief before.
fn predicted(model: &Model, belief: &Probabilities) -> Probabilities {
    let (_, height, width) = belief.dim();
    let mut out = Array3::ones(belief.dim());
    let ratio = model.ratio().expect("a kernel");
    let bias = ratio.bias().to_vec();
    let mut transition = Transition::new(ratio.kernel(), &bias, model.edge(), shape(height, width));
    let mut other = Array3::zeros(belief.dim());
    other.index_axis_mut(Axis(0), 0).fill(1.0);
    transition.apply(&other, &mut out);
    transition.apply(belief, &mut out);
    out
}

proptest! {
    // Failures are not written to a file, because tests must not change the source tree.
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..Default::default() })]

    #[test]
    fn predictions_are_those_of_the_formula(
        key in 0_u64..1_000_000,
        n_states in 2_usize..7,
        half_kernel in (0_usize..4, 0_usize..4),
        has_edge in any::<bool>(),
        side in (1_usize..12, 1_usize..70),
    ) {
        let kernel_size = [2 * half_kernel.0 + 1, 2 * half_kernel.1 + 1];
        let model = random_model(key, n_states, kernel_size);
        let model = if has_edge { with_edge(&model, key) } else { model };
        let belief = random_belief(key, n_states, side);
        let expected = formula(&model, &belief);
        let single = predicted(&model, &belief.mapv(|p| p as f32));
        prop_assert!(single.iter().all(|&p| (0.0..=1.0 + 1e-6).contains(&p)));
        let mut sums = single.sum_axis(Axis(0)).into_iter();
        prop_assert!(sums.all(|sum| (sum - 1.0).abs() < 1e-6));
        let mut off = (single.mapv(f64::from) - expected).into_iter();
        prop_assert!(off.all(|it: f64| it.abs() < 2e-6));
    }
}
