//! Checks that the examples in docs/model-file.md are valid models, and that the page names every key and its limits.

use emberwatch_model::grid::MAX_SIDE;
use emberwatch_model::text::MAX_TEXT_BYTES;
use emberwatch_model::{Description, MAX_KERNEL_SIDE, MAX_RADIUS, MAX_VALUES, MAX_ZONES};
use emberwatch_model::{Model, Shape};
use std::collections::BTreeSet;
use toml::{Table, Value};

const PAGE: &str = include_str!("../../../docs/model-file.md");

fn examples(page: &'static str) -> impl Iterator<Item = &'static str> {
    let begun = page.split("```toml\n").skip(1);
    begun.map(|rest| rest.split_once("```").expect("its end").0)
}

/// Returns the keys of a table and of its nested tables. Nested keys are prefixed with the key of their table.
fn keys(of: &str, table: &Table) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    for (key, value) in table {
        found.insert(format!("{of}{key}"));
        let entries = value.as_array().into_iter().flatten();
        let entries = entries.chain(value.is_table().then_some(value));
        for entry in entries.filter_map(Value::as_table) {
            found.extend(keys(&format!("{key} "), entry));
        }
    }
    found
}

#[test]
fn the_page_has_models_of_every_key_and_explains_each() {
    let (mut documented, mut of) = (BTreeSet::new(), String::new());
    for line in PAGE.lines() {
        let words = ["Of each of the `", "Of `"];
        let heading = words.iter().find_map(|words| line.strip_prefix(words));
        if let Some((name, _)) = heading.and_then(|rest| rest.split_once('`')) {
            of = format!("{name} ");
        } else if let Some(rest) = line.strip_prefix("| `") {
            let (key, _) = rest.split_once('`').expect("a key");
            assert!(documented.insert(format!("{of}{key}")), "{key} twice");
        }
    }
    let (mut used, mut parsed) = (BTreeSet::new(), BTreeSet::new());
    for example in examples(PAGE) {
        let model = Model::from_toml(example).expect("a model");
        let (height, width) = model.zone_map().map_or((64, 64), |map| map.dim());
        let shape = Shape::new(height, width).expect("test shape");
        assert_eq!(model.check_on(shape), Ok(()));
        used.extend(keys("", &example.parse().expect("TOML")));
        let file = Table::try_from(model.file()).expect("models serialise");
        parsed.extend(keys("", &file));
    }
    assert_eq!(used, documented);
    assert_eq!(parsed, documented);
}

#[test]
fn the_example_of_recorded_worlds_is_a_description_with_every_key() {
    let page = include_str!("../../../docs/recorded-worlds.md");
    let example = examples(page).next().expect("an example");
    let description: Description = toml::from_str(example).expect("a description");
    description.unchanging().expect("valid");
    let written: Table = example.parse().expect("TOML");
    let parsed = Table::try_from(description).expect("descriptions serialise");
    assert_eq!(keys("", &written), keys("", &parsed));
}

#[test]
fn the_limits_are_the_parser_s() {
    let readme = include_str!("../../../README.md");
    let (mebibytes, side) = (MAX_TEXT_BYTES >> 20, MAX_KERNEL_SIDE);
    for (page, words) in [
        (PAGE, format!("2 to {MAX_VALUES},")),
        (PAGE, format!("1 to {MAX_VALUES},")),
        (PAGE, format!("each odd, 1 to {side} |")),
        (PAGE, format!("0 to {MAX_ZONES} kinds of land")),
        (PAGE, format!("| `radius` | integer | 0 to {MAX_RADIUS} |")),
        (
            PAGE,
            format!("at most {mebibytes} MiB. Grids have up to {MAX_SIDE} x {MAX_SIDE} cells"),
        ),
        (readme, format!("names 2 to {MAX_VALUES} states")),
        (readme, format!("up to {side} x {side} cells")),
    ] {
        assert!(page.contains(&words), "{words:?} is not on the page");
    }
}

#[test]
fn built_in_models_have_their_names_and_fit_the_grid() {
    let shape = Shape::new(64, 64).expect("test shape");
    for name in Model::built_in_names() {
        let model = Model::built_in(name).expect(name);
        assert_eq!(model.name(), name);
        assert_eq!(model.check_on(shape), Ok(()), "{name}");
    }
    assert_eq!(Model::built_in("wildfire-dense"), None);
}
