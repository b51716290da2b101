//! Checks that tasks, models, settings and limits in the documents agree with the code.

use emberwatch_messages::capacity::{MAX_CLIENTS, MAX_ROBOT_NUMBERS, MAX_ROBOTS};
use emberwatch_model::built_in::state_names;
use emberwatch_model::grid::MAX_SIDE;
use emberwatch_model::settings::{ANY, Settings};
use emberwatch_model::task::Task;
use emberwatch_model::text::MAX_TEXT_BYTES;
use emberwatch_model::{MAX_KERNEL_SIDE, MAX_RADIUS, MAX_VALUES, Model};
use emberwatch_sim::config::ServerConfig;
use emberwatch_sim::states_file::MAX_BYTES;
use std::collections::BTreeSet;
use std::path::Path;

const ENVIRONMENTS: &str = include_str!("../../../docs/environments/index.md");

const RECORDED: &str = include_str!("../../../docs/recorded-worlds.md");

/// Returns the rows of the table whose header begins with `header`, without the commas in numbers.
fn rows(header: &str) -> Vec<String> {
    let (_, table) = ENVIRONMENTS.split_once(header).expect("the table");
    let lines = table.lines().skip(2);
    lines
        .take_while(|line| line.starts_with('|'))
        .map(|line| line.replace(',', ""))
        .collect()
}

#[test]
fn every_task_has_its_row() {
    let known = Task::built_in_names().map(|name| {
        let task = Task::named(name).expect(name);
        let config = ServerConfig {
            task: name.into(),
            ..ServerConfig::default()
        };
        let shape = config.check().expect(name).shape;
        let listing = task.listing.expect("a built-in task");
        let ids = format!("`{}` v{}", listing.ids, listing.version);
        let (settings, seeds) = (task.world, task.test_seeds);
        let world = settings.model + &settings.states;
        let (first, last) = (seeds.start, seeds.end - 1);
        let (moves, steps) = (settings.moves, settings.max_steps);
        format!(
            "| `{name}` | {ids} | `{world}` | {shape} | {moves} | {steps} | {first} to {last} |"
        )
    });
    // Removes what is only in the documents: words after the model or the states in the third column, and "up to" in
    // the sixth column of recorded worlds.
    let documented = rows("| task | ids begin with, version |")
        .into_iter()
        .map(|row| {
            let mut cells: Vec<&str> = row.split(" | ").collect();
            let world = cells[2].split_inclusive('`').take(2).collect::<String>();
            cells[2] = &world;
            cells.join(" | ").replace("up to ", "")
        });
    let (documented, known): (Vec<_>, Vec<_>) = (documented.collect(), known.collect());
    assert_eq!(
        documented.join("\n"),
        known.join("\n"),
        "docs (left), config/tasks (right)"
    );
}

#[test]
fn every_model_and_all_recorded_states_are_named() {
    let documented = rows("| model | its world |").into_iter();
    let documented: BTreeSet<String> = documented
        .filter_map(|row| Some(row.split('`').nth(1)?.to_owned()))
        .collect();
    let known: BTreeSet<String> = Model::built_in_names().map(str::to_owned).collect();
    assert_eq!(documented, known, "docs (left), config/models (right)");
    for name in state_names() {
        assert!(RECORDED.contains(&format!("`{name}`")), "{name}");
    }
}

#[test]
fn every_setting_is_explained_with_its_range() {
    let file = include_str!("../../../config/server.toml");
    let settings = ServerConfig::settings().into_iter();
    let ranges = settings.filter_map(|it| Some((it.name, it.range?)));
    for (setting, (least, most)) in ranges.filter(|(_, range)| *range != ANY) {
        let (_, text) = file.split_once(&format!("\n{setting} = ")).expect(setting);
        let mut lines = text.lines();
        let first = lines.next().into_iter();
        let lines = first.chain(lines.take_while(|line| line.starts_with(' ')));
        let words = lines
            .flat_map(str::split_whitespace)
            .filter(|word| *word != "#");
        let words = words.collect::<Vec<_>>().join(" ");
        // The documented range of the radius starts at 0, because the document explains -1 in words.
        let range = format!("{} to {most}", least.max(0));
        assert!(
            words.contains(&range),
            "{setting}: expected {range}, got {words}"
        );
    }
}

#[test]
fn the_limits_are_those_of_the_code() {
    let (mebibytes, gibibytes) = (MAX_TEXT_BYTES >> 20, MAX_BYTES >> 30);
    let limits = format!(
        "docs/model-file.md => 2 to {MAX_VALUES},
        docs/model-file.md => 1 to {MAX_VALUES},
        docs/model-file.md => each odd, 1 to {MAX_KERNEL_SIDE} |
        docs/model-file.md => an odd number of rows and of columns up to {MAX_KERNEL_SIDE}
        docs/model-file.md => | `radius` | integer | 0 to {MAX_RADIUS} |
        docs/model-file.md => at most {mebibytes} MiB. Grids have up to {MAX_SIDE} x {MAX_SIDE} cells
        README.md => names 2 to {MAX_VALUES} states
        README.md => up to {MAX_KERNEL_SIDE} x {MAX_KERNEL_SIDE} cells
        docs/recorded-worlds.md => Grids have up to {MAX_SIDE} x {MAX_SIDE} cells, all sequences together up to {gibibytes} GiB
        docs/recorded-worlds.md => at most {MAX_VALUES}.
        docs/landscapes.md => more than {MAX_SIDE} x {MAX_SIDE} cells, as the server takes
        clients/python/README.md => may have up to {MAX_ROBOTS} robots
        clients/python/README.md => takes {MAX_CLIENTS} clients at a time
        docs/many-machines.md => takes {MAX_CLIENTS} clients at a time, and {MAX_ROBOT_NUMBERS} robots"
    );
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    for line in limits.lines() {
        let (page, words) = line.trim().split_once(" => ").expect(line);
        let text = std::fs::read_to_string(root.join(page)).expect(page);
        let text: Vec<&str> = text.split_whitespace().collect();
        let text = text.join(" ").replace("4,096", "4096");
        assert!(text.contains(words), "{words:?} is not in {page}");
    }
}
