//! What comes from outside is hostile: every decoder gives an error or a valid value, never a panic. What bytes can be
//! damaged to, and what must hold of what is decoded, is in `tests/src/fuzz/`.

use emberwatch_model::{Model, parse_color};
use proptest::prelude::*;

proptest! {
    // No file of failures: tests leave the source tree alone.
    #![proptest_config(ProptestConfig { failure_persistence: None, ..Default::default() })]

    #[test]
    fn any_text_is_a_color_or_none(text in "#?.{0,8}") {
        let is_color = text.len() == 7
            && text.starts_with('#')
            && text[1..].bytes().all(|byte| byte.is_ascii_hexdigit());
        prop_assert_eq!(parse_color(&text).is_some(), is_color);
    }
}

#[test]
fn nesting_as_deep_as_a_model_file_can_be_is_refused() {
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
