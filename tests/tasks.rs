//! Tests of tasks: `hello`, `status` and snapshots name them, and commands take worlds, steps and seeds from them.

use crate::commands::{agent, check, check_table};
use emberwatch_agent::benchmark::report::runs_file::read_runs;
use emberwatch_sim::snapshot::decode;
use tests::harness::{AGENT, Folder, SERVER, Server, repository};

/// Returns the text of a built-in task, renamed to `mine`.
fn mine(task: &str) -> String {
    let text = std::fs::read_to_string(repository().join(format!("config/tasks/{task}.toml")));
    let text = text.expect("the task");
    text.replace(&format!("name = \"{task}\""), "name = \"mine\"")
}

#[test]
fn hello_status_and_snapshots_name_the_task() {
    let folder = Folder::default();
    let named = Server::start("--task small");
    named.command("status").check_prints(": task small, pid ");
    let by_hand = Server::start(
        "--model wildfire-small --height 16 --width 16 --moves 16 --burn-in 3000 --max-steps 300",
    );
    // A snapshot from a server with a task can be restored on a server with the same settings from flags, and the other
    // way round.
    for (from, to, task) in [(&named, &by_hand, Some("small")), (&by_hand, &named, None)] {
        assert_eq!(from.info().task.as_deref(), task);
        let json = from.command("status --json").check(0).stdout;
        let status: serde_json::Value = serde_json::from_str(&json).expect("JSON");
        assert_eq!(status.get("task").and_then(|task| task.as_str()), task);
        let file = folder.word("one.snapshot");
        from.command(&format!("snapshot {file}")).check(0);
        let snapshot = decode(&folder.bytes("one.snapshot")).expect("a snapshot");
        let name = ("task".to_owned(), "small".to_owned());
        let is_named = snapshot.settings.others.contains(&name);
        assert_eq!(is_named, task.is_some());
        to.command(&format!("restore {file} --takeover")).check(0);
    }
}

#[test]
fn commands_of_the_agent_take_worlds_steps_and_seeds_of_a_task() {
    let folder = Folder::default();
    let text = mine("team").replace("end = 32", "end = 2");
    let task = folder.write(
        "own.toml",
        text.replace("max_steps = 300", "max_steps = 1501"),
    );
    let csv = folder.word("rows.csv");
    let policies = "--policies coverage --baseline coverage";
    agent(&format!("compare --task {task} {policies} --csv {csv}"));
    let runs = read_runs(&folder.path("rows.csv")).expect("rows");
    let runs = runs
        .iter()
        .map(|run| (run.world_seed, run.steps, run.robots));
    assert_eq!(Vec::from_iter(runs), [(0, 1501, 4), (1, 1501, 4)]);
    let out = folder.word("learned");
    agent(&format!(
        "train --task {task} --worlds 2 --steps 8 --out {out}"
    ));
}

#[test]
fn files_and_flags_that_a_task_does_not_allow_are_refused() {
    let folder = Folder::default();
    // Opening a pipe would wait forever for a writer.
    let pipe = folder.word("pipe");
    let made = std::process::Command::new("mkfifo").arg(&pipe).status();
    assert!(made.expect("mkfifo").success());
    let of_pipe = folder.write(
        "of_pipe.toml",
        mine("small").replace("wildfire-small", "pipe"),
    );
    let moved = mine("small")
        .replace("mine", "small")
        .replace("moves = 16", "moves = 15");
    let moved = folder.write("moved.toml", moved);
    let table = format!(
        "--task {of_pipe} => model: expected a regular file, got a pipe
--task {pipe} => expected a regular file, got a pipe
--task {moved} => name: expected a name that no built-in task has, got small
--task small --sensor-radius 1 => sensor_radius: expected to be left out, as the task decides it"
    );
    check_table(SERVER, &table);
    let table = "compare --task small --robots 2 => robots: expected to be left out, as the task decides it
train --task small --moves 3 --out x => moves: expected to be left out, as the task decides it, got 3";
    check_table(AGENT, table);
    for (setting, name, task) in [
        ("model", "wildfire-small", "small"),
        ("states", "jacksboro", "jacksboro"),
    ] {
        let file = folder.write("mine.toml", mine(task));
        folder.write(name, "");
        let words =
            format!("{setting}: {name} is a built-in name and also a file next to the task");
        check(SERVER, &format!("--task {file}"), &words);
    }
}
