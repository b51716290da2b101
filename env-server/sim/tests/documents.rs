//! Tasks, models, settings and limits in the documents are those of the code.

use emberwatch_messages::capacity::{MAX_CLIENTS, MAX_ROBOT_NUMBERS, MAX_ROBOTS};
use emberwatch_model::built_in::state_names;
use emberwatch_model::grid::MAX_SIDE;
use emberwatch_model::task::Task;
use emberwatch_model::{MAX_VALUES, Model};
use emberwatch_sim::bounds::BOUNDS;
use emberwatch_sim::config::ServerConfig;
use emberwatch_sim::states_file::MAX_BYTES;
use std::collections::BTreeSet;

const ENVIRONMENTS: &str = include_str!("../../../docs/environments/index.md");

const RECORDED: &str = include_str!("../../../docs/recorded-worlds.md");

/// The cells of each row of the table whose header begins like this, without the marks of thousands.
fn rows(header: &str) -> Vec<Vec<String>> {
    let (_, table) = ENVIRONMENTS.split_once(header).expect("the table");
    let lines = table.lines().skip(2);
    let cells = |line: &str| {
        let cells = line.trim_matches('|').split('|');
        cells.map(|cell| cell.trim().replace(',', "")).collect()
    };
    lines
        .take_while(|line| line.starts_with('|'))
        .map(cells)
        .collect()
}

/// The row of a task, without words about its world.
fn row(name: &str) -> String {
    let task = Task::named(name).expect(name);
    let config = ServerConfig {
        task: name.into(),
        ..ServerConfig::default()
    };
    let shape = config.check().expect(name).shape;
    let ids = task.listing.expect("a built-in task").ids;
    let (world, seeds) = (task.model + &task.states, task.test_seeds);
    format!(
        "| `{name}` | `{ids}` | `{world}` | {shape} | {} | {} | {} to {} |",
        task.moves,
        task.max_steps,
        seeds.start,
        seeds.end - 1
    )
}

#[test]
fn every_task_has_its_row() {
    let documented = rows("| task | ids begin with |")
        .into_iter()
        .map(|mut row| {
            // The model or the states, then words; the longest of recorded episodes.
            row[2] = format!("`{}`", row[2].split('`').nth(1).unwrap_or_default());
            row[5] = row[5].replace("up to ", "");
            format!("| {} |", row.join(" | "))
        });
    let known: Vec<String> = Task::built_in_names().map(row).collect();
    assert_eq!(
        documented.collect::<Vec<_>>().join("\n"),
        known.join("\n"),
        "docs/environments/index.md (left), config/tasks (right)"
    );
}

#[test]
fn every_model_and_all_recorded_states_are_named() {
    let documented = rows("| model | its world |").into_iter();
    let documented: BTreeSet<String> = documented.map(|row| row[0].clone()).collect();
    let known: BTreeSet<String> = Model::built_in_names()
        .map(|name| format!("`{name}`"))
        .collect();
    assert_eq!(
        documented, known,
        "docs/environments/index.md (left), config/models (right)"
    );
    for name in state_names() {
        let words = format!("`{name}`");
        let is_named = RECORDED.contains(&words);
        assert!(is_named, "{words} is not in docs/recorded-worlds.md");
    }
}

#[test]
fn every_setting_is_explained_with_its_range() {
    let file = include_str!("../../../config/server.toml");
    for (setting, least, most) in BOUNDS
        .into_iter()
        .filter(|(.., most)| *most < i128::from(u64::MAX))
    {
        let (_, text) = file.split_once(&format!("\n{setting} = ")).expect(setting);
        let mut lines = text.lines();
        let first = lines.next().expect(setting);
        let more = lines.take_while(|line| line.starts_with(' '));
        let words: Vec<&str> = std::iter::once(first)
            .chain(more)
            .flat_map(str::split_whitespace)
            .filter(|word| *word != "#")
            .collect();
        // A radius of -1 is explained in words.
        let range = format!("{} to {most}", least.max(0));
        assert!(
            words.join(" ").contains(&range),
            "{setting}: expected {range} in config/server.toml"
        );
    }
}

#[test]
fn the_limits_are_those_of_the_code() {
    let python = include_str!("../../../clients/python/README.md");
    let machines = include_str!("../../../docs/many-machines.md");
    let landscapes = include_str!("../../../docs/landscapes.md");
    let side = format!("{MAX_SIDE} x {MAX_SIDE} cells");
    for (page, words) in [
        (
            RECORDED,
            format!(
                "Grids have up to {side}, all sequences together up to {} GiB",
                MAX_BYTES >> 30
            ),
        ),
        (RECORDED, format!("at most {MAX_VALUES}.")),
        (landscapes, format!("more than {side}, as the server takes")),
        (python, format!("may have up to {MAX_ROBOTS} robots")),
        (python, format!("takes {MAX_CLIENTS} clients at a time")),
        (
            machines,
            format!("takes {MAX_CLIENTS} clients at a time, and {MAX_ROBOT_NUMBERS} robots"),
        ),
    ] {
        let page = page
            .split_whitespace()
            .collect::<Vec<_>>()
            .join(" ")
            .replace("4,096", "4096");
        assert!(page.contains(&words), "{words:?} is on no page");
    }
}
