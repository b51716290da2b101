//! Checks that the examples in docs/model-file.md are valid models, and that the page names every key.

use emberwatch_model::{Description, MapsEntry, Model, ModelFile, Shape};
use ndarray::ArrayD;
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
        if ["maps", "near"].contains(&key.as_str()) {
            // The keys of `near` are names of states.
            continue;
        }
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
        } else if line == "Of the model:" {
            of.clear();
        } else if let Some(rest) = line.strip_prefix("| `") {
            let (key, _) = rest.split_once('`').expect("a key");
            assert!(documented.insert(format!("{of}{key}")), "{key} twice");
        }
    }
    let (mut used, mut parsed) = (BTreeSet::new(), BTreeSet::new());
    for example in examples(PAGE) {
        let mut file: ModelFile = toml::from_str(example).expect("a model file");
        let land = [
            ("fuel".to_owned(), ArrayD::ones(vec![2, 4])),
            ("wind".to_owned(), ArrayD::ones(vec![1, 3, 2, 4])),
        ];
        file.maps = file.maps.map(|_| MapsEntry::packed(&land.into()));
        let model = Model::new(file).expect("a model");
        let shape = Shape::new(2, 4).expect("test shape");
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
fn built_in_models_have_their_names_and_fit_the_grid() {
    let shape = Shape::new(64, 64).expect("test shape");
    for name in Model::built_in_names() {
        let model = Model::built_in(name).expect(name);
        assert_eq!(model.name(), name);
        assert_eq!(model.check_on(shape), Ok(()), "{name}");
    }
    assert_eq!(Model::built_in("wildfire-dense"), None);
}
