//! docs/model-file.md: its example is a model, and it names every key with its limits.

use emberwatch_model::grid::MAX_SIDE;
use emberwatch_model::text::MAX_TEXT_BYTES;
use emberwatch_model::{Description, MAX_KERNEL_SIDE, MAX_RADIUS, MAX_VALUES, MAX_ZONES};
use emberwatch_model::{Model, Shape};
use std::collections::BTreeSet;
use toml::{Table, Value};

const PAGE: &str = include_str!("../../../docs/model-file.md");

/// A model for all cells, and one by the cell's own state.
fn examples() -> Vec<&'static str> {
    examples_of(PAGE)
}

fn examples_of(page: &'static str) -> Vec<&'static str> {
    let begun = page.split("```toml\n").skip(1);
    begun
        .map(|rest| rest.split_once("```").expect("its end").0)
        .collect()
}

/// The keys of a table and of the tables in it; those below are named with what they are of.
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

/// The keys that the page's tables have.
fn documented() -> BTreeSet<String> {
    let mut of = String::new();
    let mut found = BTreeSet::new();
    for line in PAGE.lines() {
        if let Some(rest) = line.strip_prefix("Of each of the `") {
            let (name, _) = rest.split_once('`').expect("a name");
            of = format!("{name} ");
        } else if let Some(rest) = line.strip_prefix("Of `") {
            let (name, _) = rest.split_once('`').expect("a name");
            of = format!("{name} ");
        } else if let Some(rest) = line.strip_prefix("| `") {
            let (key, _) = rest.split_once('`').expect("a key");
            assert!(found.insert(format!("{of}{key}")), "{key} twice");
        }
    }
    found
}

#[test]
fn the_examples_are_models_that_use_every_key() {
    let mut used = BTreeSet::new();
    for example in examples() {
        let model = Model::from_toml(example).expect("a model");
        let (height, width) = model.zone_map().map_or((64, 64), |map| map.dim());
        let shape = Shape::new(height, width).expect("test shape");
        assert_eq!(model.check_on(shape), Ok(()));
        used.extend(keys("", &example.parse().expect("TOML")));
    }
    assert_eq!(used, documented());
}

#[test]
fn the_example_of_recorded_worlds_is_a_description_with_every_key() {
    let page = include_str!("../../../docs/recorded-worlds.md");
    let example = examples_of(page)[0];
    let description: Description = toml::from_str(example).expect("a description");
    description.unchanging().expect("valid");
    let written: Table = example.parse().expect("TOML");
    let parsed = Table::try_from(description).expect("descriptions serialise");
    assert_eq!(keys("", &written), keys("", &parsed));
}

#[test]
fn every_key_of_the_parser_is_on_the_page() {
    let mut parsed = BTreeSet::new();
    let names = ["wildfire", "wildfire-burnout"].into_iter();
    let models = names.map(|name| Model::built_in(name).expect("a built-in model"));
    let of_page = examples().into_iter().map(Model::from_toml);
    for model in models.chain(of_page.map(|model| model.expect("a model"))) {
        let file = Table::try_from(model.file().clone()).expect("models serialise");
        parsed.extend(keys("", &file));
    }
    assert_eq!(documented(), parsed);
}

#[test]
fn the_limits_are_the_parser_s() {
    let mebibytes = MAX_TEXT_BYTES >> 20;
    for words in [
        format!("2 to {MAX_VALUES},"),
        format!("1 to {MAX_VALUES},"),
        format!("each odd, 1 to {MAX_KERNEL_SIDE} |"),
        format!("0 to {MAX_ZONES} kinds of land"),
        format!("| `radius` | integer | 0 to {MAX_RADIUS} |"),
        format!("at most {mebibytes} MiB. Grids have up to {MAX_SIDE} x {MAX_SIDE} cells"),
    ] {
        assert!(PAGE.contains(&words), "{words:?} is not on the page");
    }
    let readme = include_str!("../../../README.md");
    assert!(readme.contains(&format!("names 2 to {MAX_VALUES} states")));
    assert!(readme.contains(&format!(
        "up to {MAX_KERNEL_SIDE} x {MAX_KERNEL_SIDE} cells"
    )));
}
