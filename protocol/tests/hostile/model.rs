//! Model files: refused, or they run.

use crate::models::{random_model, random_own_model};
use ndarray::{Array3, Axis};
use proptest::collection::vec;
use proptest::prelude::*;
use proptest::sample::select;
use protocol::model::{ModelFile, parse_color};
use protocol::{Dynamics, Model, Shape, Transition};

/// Numbers that break what is not checked.
const NUMBERS: [&str; 20] = [
    "nan",
    "-nan",
    "inf",
    "-inf",
    "1e308",
    "1e200",
    "1e101",
    "1e100",
    "1e30",
    "1e-30",
    "1e-45",
    "1e-100",
    "1e-101",
    "1e-320",
    "-1e-320",
    "-0.0",
    "0",
    "1",
    "-1",
    "9223372036854775807",
];

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..Default::default() })]

    #[test]
    fn any_text_is_a_color_or_none(text in "#?.{0,8}") {
        let is_color = text.len() == 7
            && text.starts_with('#')
            && text[1..].bytes().all(|byte| byte.is_ascii_hexdigit());
        prop_assert_eq!(parse_color(&text).is_some(), is_color);
    }

    #[test]
    fn a_model_file_of_hostile_numbers_is_refused_or_runs(
        numbers in vec(prop_oneof![3 => select(&["0", "1", "1e-30", "1e30"][..]), 1 => select(&NUMBERS[..])], 12),
        biases in vec(select(&["0", "0", "1e-30", "1", "1e100", "1e308", "1e-320"][..]), 3),
    ) {
        let mut file = Model::wildfire().file().clone();
        let number = |text: &&str| text.parse::<f64>().expect("a number");
        for (entry, pair) in file.kernel.iter_mut().zip(numbers.chunks(2)) {
            entry.weights[1][1] = number(&pair[0]);
            entry.scale = number(&pair[1]);
        }
        for (state, bias) in file.states.iter_mut().zip(&biases) {
            state.bias = number(bias);
            state.reward = number(&numbers[0]);
        }
        check_file(file);
    }

    #[test]
    fn model_files_survive_toml(key in any::<u64>(), n_states in 2usize..6, side in (0usize..3, 0usize..3)) {
        let kernel_size = [2 * side.0 + 1, 2 * side.1 + 1];
        let key = key >> 1;
        for model in [random_model(key, n_states, kernel_size), random_own_model(key, n_states, kernel_size)] {
            let text = toml::to_string(model.file()).expect("models serialise");
            prop_assert_eq!(Model::from_toml(&text), Ok(model));
        }
    }
}

#[test]
fn nesting_as_deep_as_a_file_can_be_is_refused() {
    for (open, close) in [("[", "]"), ("{a = ", "}"), ("[{a = ", "}]")] {
        let deep = open.repeat(100_000) + "1" + &close.repeat(100_000);
        assert!(Model::from_toml(&format!("name = {deep}\n")).is_err());
        assert!(Model::from_toml(&format!("kernel_size = {deep}\n")).is_err());
    }
    let keys = "a.".repeat(100_000);
    assert!(Model::from_toml(&format!("{keys}b = 1\n")).is_err());
    assert!(Model::from_toml(&format!("[{keys}b]\n")).is_err());
}

#[test]
fn a_model_file_of_any_size_is_refused_before_memory_is_asked_for() {
    let wildfire = toml::to_string(Model::wildfire().file()).expect("models serialise");
    for size in [
        "[15, 99999999]",
        "[9223372036854775807, 9223372036854775807]",
        "[-1, 3]",
    ] {
        let text = wildfire.replacen("[3, 3]", size, 1);
        assert!(Model::from_toml(&text).is_err(), "{size}");
    }
    let state = "[[states]]\nname = \"x\"\ncolor = \"#000000\"\ninitial = 0.0\nobserved_as = [1.0, 0.0, 0.0]\n";
    assert!(Model::from_toml(&(wildfire.clone() + &state.repeat(10_000))).is_err());
    let entry = "[[kernel]]\nfrom = \"fire\"\nto = \"fire\"\nweights = []\n";
    assert!(Model::from_toml(&(wildfire + &entry.repeat(10_000))).is_err());
}

/// A model that is accepted can be simulated and filtered on every grid that it is accepted on.
fn check_file(file: ModelFile) {
    let Ok(model) = Model::new(file) else { return };
    for (height, width) in [(1, 1), (2, 5), (4, 17)] {
        let shape = Shape::new(height, width).expect("a small grid");
        if model.check_on(shape).is_err() {
            assert!(Transition::<f32>::new(&model, shape).is_err());
            assert!(Dynamics::new(&model, shape).is_err());
            continue;
        }
        check_beliefs(&model, shape);
        check_dynamics(&model, shape);
    }
}

fn check_beliefs(model: &Model, shape: Shape) {
    let mut phi = Transition::<f32>::new(model, shape).expect("checked");
    let dim = (model.n_states(), shape.height(), shape.width());
    for certain in 0..=model.n_states() {
        let belief = Array3::from_shape_fn(dim, |(state, _, _)| match certain {
            all if all == dim.0 => 1.0 / dim.0 as f32,
            one if one == state => 1.0,
            _ => 0.0,
        });
        let mut next = Array3::zeros(dim);
        phi.apply(&belief, &mut next);
        for sum in next.sum_axis(Axis(0)) {
            assert!(
                (sum - 1.0).abs() < 1e-3,
                "a belief sums to {sum}: {model:?}"
            );
        }
        assert!(next.iter().all(|p| (0.0..=1.001).contains(p)), "{next}");
    }
}

fn check_dynamics(model: &Model, shape: Shape) {
    let mut dynamics = Dynamics::new(model, shape).expect("checked");
    let mut states = dynamics.initial(1);
    for step in 0..20 {
        let reward: f64 = states.iter().map(|s| model.reward()[usize::from(*s)]).sum();
        assert!(reward.is_finite(), "the reward sums to {reward}");
        dynamics.step(1, step, &mut states);
    }
    assert!(states.iter().all(|s| usize::from(*s) < model.n_states()));
}
