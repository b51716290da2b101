//! Tests of tasks: `hello`, `status` and snapshots name them, and commands take worlds, steps and seeds from them.

use crate::commands::{agent, check, check_table};
use emberwatch_agent::benchmark::report::runs_file::read_runs;
use emberwatch_protocol::task::Task;
use emberwatch_sim::snapshot::decode;
use tests::harness::{AGENT, Folder, SERVER, Server, repository};

/// The settings of the task `small` as flags.
const SMALL_BY_HAND: &str =
    "--model wildfire-small --height 16 --width 16 --moves 16 --burn-in 3000 --max-steps 300";

/// Returns the text of a built-in task, renamed to `mine`.
fn mine(task: &str) -> String {
    let text = std::fs::read_to_string(repository().join(format!("config/tasks/{task}.toml")));
    let text = text.expect("the task");
    text.replace(&format!("name = \"{task}\""), "name = \"mine\"")
}

#[test]
fn hello_status_and_snapshots_name_the_task() {
    let folder = Folder::default();
    let server = Server::start("--task small");
    assert_eq!(server.info().task.as_deref(), Some("small"));
    server.command("status").check_prints(": task small, pid ");
    let json = |server: &Server| {
        let text = server.command("status --json").check(0).stdout;
        serde_json::from_str::<serde_json::Value>(&text).expect("JSON")
    };
    assert_eq!(json(&server)["task"], "small");
    let by_hand = Server::start(SMALL_BY_HAND);
    assert_eq!(by_hand.info().task, None);
    assert_eq!(json(&by_hand).get("task"), None);
    // A snapshot from a server with a task can be restored on a server with the same settings from flags, and the other
    // way round.
    for (from, to, is_named) in [(&server, &by_hand, true), (&by_hand, &server, false)] {
        let file = folder.word("one.snapshot");
        from.command(&format!("snapshot {file}")).check(0);
        let settings = decode(&folder.bytes("one.snapshot"))
            .expect("a snapshot")
            .settings;
        let named = ("task".to_owned(), "small".to_owned());
        assert_eq!(settings.others.contains(&named), is_named);
        to.command(&format!("restore {file} --takeover")).check(0);
    }
}

#[test]
fn commands_of_the_agent_take_worlds_steps_and_seeds_of_a_task() {
    let folder = Folder::default();
    let text = mine("team");
    for (max_steps, n_seeds) in [(3, 2), (1600, 1)] {
        let task = text.replace("max_steps = 300", &format!("max_steps = {max_steps}"));
        let task = task.replace("end = 32", &format!("end = {n_seeds}"));
        let (task, csv) = (folder.write("own.toml", task), folder.word("rows.csv"));
        let policies = "--policies coverage --baseline coverage";
        agent(&format!("compare --task {task} {policies} --csv {csv}"));
        let runs = read_runs(&folder.path("rows.csv")).expect("rows");
        assert!(runs.iter().map(|run| run.world_seed).eq(0..n_seeds));
        // This also holds if a task has more steps and robots than a comparison has by default.
        assert!(
            runs.iter()
                .all(|run| (run.steps, run.robots) == (max_steps, 4)),
            "{runs:?}"
        );
        if n_seeds > 1 {
            let out = folder.word("learned");
            agent(&format!(
                "train --task {task} --worlds 2 --steps 8 --out {out}"
            ));
            assert!(folder.path("learned/checkpoint.safetensors").exists());
        }
    }
}

#[test]
fn wrong_tasks_and_flags_that_a_task_decides_are_refused_by_name() {
    let folder = Folder::default();
    let file = folder.write("task.toml", "name = 'mine'\n");
    let other = mine("small")
        .replace("\"mine\"", "\"small\"")
        .replace("moves = 16", "moves = 15");
    let other = folder.write("other.toml", other);
    // A pipe as a task file is refused; opening it would wait forever for a writer.
    let pipe = folder.word("pipe");
    let made = std::process::Command::new("mkfifo").arg(&pipe).status();
    assert!(made.expect("mkfifo").success());
    let of_pipe = mine("small").replace("wildfire-small", "pipe");
    let of_pipe = folder.write("of_pipe.toml", of_pipe);
    let words = "model: expected a regular file, got a pipe";
    check(SERVER, &format!("--task {of_pipe}"), words);
    let table =
        "--task small --sensor-radius 1 => sensor_radius: expected to be left out, as the task decides it
--task jacksboro --states-offset 3 => states_offset: expected to be left out, as the task decides it
--task= => task : expected a name or a file, got \"\"
--task FILE => missing field `test_seeds`
--task OTHER => name: expected a name that no built-in task has, got small
--task PIPE => expected a regular file, got a pipe";
    let table = table.replace("FILE", &file).replace("OTHER", &other);
    check_table(SERVER, &table.replace("PIPE", &pipe));
    let table =
        "compare --task small --height 3 => height: expected to be left out, as the task decides it, got 3
compare --task small --robots 2 => robots: expected to be left out, as the task decides it
train --task small --moves 3 --out x => moves: expected to be left out, as the task decides it, got 3
compare --task ash => task ash: No such file | expected a file, or one of wildfire, small
compare --task PIPE => expected a regular file, got a pipe";
    check_table(AGENT, &table.replace("PIPE", &pipe));
    for (setting, name, task) in [
        ("model", "wildfire-small", "small"),
        ("states", "jacksboro", "jacksboro"),
    ] {
        let file = folder.write("mine.toml", mine(task));
        Task::named(&file).expect("a task of a built-in name");
        folder.write(name, "");
        let words =
            format!("{setting}: {name} is a built-in name and also a file next to the task");
        check(SERVER, &format!("--task {file}"), &words);
    }
}
