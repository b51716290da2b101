//! Tasks: the worlds of a name are those of the same flags, and all that knows the server names it.

use crate::commands::{agent, check, check_table};
use crate::recording::{read_whole, start_recorder, stop};
use emberwatch_protocol::recording::Event;
use emberwatch_protocol::task::Task;
use emberwatch_sim::snapshot::decode;
use tempfile::TempDir;
use tests::harness::{AGENT, Paths, Program, SERVER, Server, fly, repository, reset, seen_by};

/// The task `small`, by hand.
const SMALL_BY_HAND: &str =
    "--model wildfire-small --height 16 --width 16 --moves 16 --burn-in 3000 --max-steps 300";

#[test]
fn a_task_has_the_worlds_of_its_flags() {
    let seen = |flags: &str| {
        let server = Server::start(flags);
        let (mut client, mut paths) = (server.acquire(0..1), Paths::new(1));
        reset(&mut client, 7);
        let step = |_| seen_by(&fly(&mut client, paths.next(16)));
        let seen: Vec<_> = (0..20).map(step).collect();
        (seen, server.info().max_steps)
    };
    let by_name = seen("--task small");
    let file = repository().join("config/tasks/small.toml");
    assert_eq!(by_name, seen(&format!("--task {}", file.display())));
    assert_eq!(by_name, seen(SMALL_BY_HAND));
}

#[test]
fn hello_status_and_recordings_name_the_task() {
    let folder = TempDir::new().expect("a folder");
    let file = folder.path().join("task.recording");
    let server = Server::start("--task small");
    assert_eq!(server.info().task.as_deref(), Some("small"));
    let status = server.command("status").check(0).stdout;
    assert!(status.contains(": task small, pid "), "{status}");
    let json = |server: &Server| {
        let text = server.command("status --json").check(0).stdout;
        serde_json::from_str::<serde_json::Value>(&text).expect("JSON")
    };
    assert_eq!(json(&server)["task"], "small");
    let recorder = start_recorder(&server.instance, &file, "");
    fly(&mut server.acquire(0..1), Paths::new(1).next(16));
    stop(recorder);
    let named = |event: &Event| matches!(event, Event::Server(info) if info.task.as_deref() == Some("small"));
    assert!(read_whole(&file).iter().any(|record| named(&record.event)));
    let by_hand = Server::start(SMALL_BY_HAND);
    assert_eq!(by_hand.info().task, None);
    assert_eq!(json(&by_hand).get("task"), None);
}

#[test]
fn a_snapshot_of_a_task_fits_the_same_worlds_by_flags() {
    let folder = TempDir::new().expect("a folder");
    for (from, to) in [
        ("--task small", SMALL_BY_HAND),
        (SMALL_BY_HAND, "--task small"),
    ] {
        let file = folder.path().join("one.snapshot");
        let server = Server::start(from);
        server
            .command(&format!("snapshot {}", file.display()))
            .check(0);
        let bytes = std::fs::read(&file).expect("a snapshot");
        let settings = decode(&bytes).expect("a snapshot").settings;
        let named = ("task".to_owned(), "small".to_owned());
        assert_eq!(settings.others.contains(&named), from.contains("task"));
        let other = Server::start(&format!("{to} --seed 9"));
        other
            .command(&format!("restore {}", file.display()))
            .check(0);
    }
}

#[test]
fn an_agent_refuses_a_server_of_another_task() {
    let folder = TempDir::new().expect("a folder");
    let own = folder.path().join("own.toml");
    let text = std::fs::read_to_string(repository().join("config/tasks/small.toml"));
    let text = text
        .expect("the task")
        .replace("name = \"small\"", "name = \"own\"");
    std::fs::write(&own, &text).expect("write");
    let of_own = format!("--task {}", own.display());
    let server = Server::start(&of_own);
    let flags = format!("--steps 1 --policy coverage {of_own}");
    Program::agent(&server.instance, &flags).ends(0);
    // What counts is what the server runs, not what it is called.
    for (from, to, words) in [
        (
            "burn_in = 3000",
            "burn_in = 30",
            "the burn_in of task own: 30, got 3000",
        ),
        (
            "moves = 16",
            "moves = 15",
            "the moves of task own: 15, got 16",
        ),
        (
            "wildfire-small",
            "wildfire",
            "the model of task own: wildfire, got another",
        ),
    ] {
        assert!(text.contains(from));
        std::fs::write(&own, text.replace(from, to)).expect("write");
        let refused = Program::agent(&server.instance, &flags);
        refused.ends(1).check_says(words);
    }
    let server = Server::start("--task small");
    let flags = "--steps 1 --policy coverage";
    Program::agent(&server.instance, &format!("{flags} --task small")).ends(0);
    let refused = Program::agent(&server.instance, &format!("{flags} --task team"));
    refused.ends(1).check_says("expected task team, got small");
}

#[test]
fn commands_of_the_agent_take_worlds_steps_and_seeds_of_a_task() {
    let folder = TempDir::new().expect("a folder");
    let (csv, long) = (folder.path().join("a.csv"), folder.path().join("long.csv"));
    let own = folder.path().join("own.toml");
    let text = std::fs::read_to_string(repository().join("config/tasks/team.toml"));
    let text = text
        .expect("the task")
        .replace("max_steps = 300", "max_steps = 3")
        .replace("name = \"team\"", "name = \"mine\"");
    std::fs::write(&own, text.replace("end = 32", "end = 2")).expect("write");
    let task = format!("--task {}", own.display());
    let policies = "--policies coverage --baseline coverage";
    agent(&format!(
        "compare {task} {policies} --csv {}",
        csv.display()
    ))
    .check(0);
    let rows = std::fs::read_to_string(&csv).expect("a table");
    assert_eq!(rows.lines().count(), 1 + 2, "{rows}");
    // The task's steps, also where these are more than a comparison has by default.
    let more = text
        .replace("end = 32", "end = 1")
        .replace("max_steps = 3", "max_steps = 1600");
    std::fs::write(&own, more).expect("write");
    let compare = format!("compare {task} {policies}");
    agent(&format!("{compare} --csv {}", long.display())).check(0);
    let rows = std::fs::read_to_string(&long).expect("a table");
    assert!(rows.contains("coverage,none,0,1600,"), "{rows}");
    std::fs::write(&own, text.replace("end = 32", "end = 2")).expect("write");
    let out = folder.path().join("learned");
    agent(&format!(
        "train {task} --worlds 2 --steps 8 --out {}",
        out.display()
    ))
    .check(0);
    assert!(out.join("checkpoint.safetensors").exists());
}

#[test]
fn flags_that_a_task_decides_are_refused_by_name() {
    let folder = TempDir::new().expect("a folder");
    let file = folder.path().join("task.toml");
    std::fs::write(&file, "name = 'mine'\n").expect("write");
    let other = folder.path().join("other.toml");
    let small = std::fs::read_to_string(repository().join("config/tasks/small.toml"));
    let small = small.expect("the task").replace("moves = 16", "moves = 15");
    std::fs::write(&other, small).expect("write");
    let table =
        "--task small --height 3 => height: expected to be left out, as the task decides it, got 3
--task small --model wildfire => model: expected to be left out, as the task decides it
--task small --robots 1 => robots: expected to be left out, as the task decides it
--task small --max-steps 3 => max_steps: expected to be left out, as the task decides it
--task small --start corner => start: expected to be left out, as the task decides it
--task jacksboro --states-offset 3 => states_offset: expected to be left out, as the task decides it
--task ash => task ash: No such file | expected one, or wildfire, small
--task= => task : expected a name or a file, got \"\"
--task FILE => missing field `moves`
--task OTHER => name: expected one of its own, got small, which is built in";
    let table = table.replace("FILE", &file.display().to_string());
    let table = table.replace("OTHER", &other.display().to_string());
    check_table(SERVER, &table);
    let table =
        "compare --task small --height 3 => --task <NAME|FILE> | cannot be used with | --height
compare --task small --robots 2 => --robots | cannot be used with | --task
compare --task small --burn-in 2 => --burn-in | cannot be used with | --task
train --task small --moves 3 --out x => --task <NAME|FILE> | cannot be used with | --moves
evaluate --task ash --checkpoint x => task ash: No such file | expected one, or wildfire, small
run --task ash => task ash: No such file";
    check_table(AGENT, table);
}

#[test]
fn files_that_have_a_built_in_name_or_are_pipes_are_refused() {
    let folder = TempDir::new().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    for (setting, name, task) in [
        ("model", "wildfire-small", "small"),
        ("states", "jacksboro", "jacksboro"),
    ] {
        let text = std::fs::read_to_string(repository().join(format!("config/tasks/{task}.toml")));
        let mine = text
            .expect("the task")
            .replace(&format!("name = \"{task}\""), "name = \"mine\"");
        let file = path(&format!("{setting}.toml"));
        std::fs::write(&file, mine).expect("write");
        Task::named(&file.display().to_string()).expect("a task of a built-in name");
        std::fs::write(path(name), "").expect("write");
        let words = format!("{setting}: expected a file with a name of its own, got {name}");
        check(SERVER, &format!("--task {}", file.display()), &words);
    }
    // No reader waits for a writer that never comes.
    let pipe = path("pipe").display().to_string();
    let made = std::process::Command::new("mkfifo").arg(&pipe).status();
    assert!(made.expect("mkfifo").success());
    let words = "expected a regular file, got a pipe";
    check(SERVER, &format!("--task {pipe}"), words);
    check(AGENT, &format!("compare --task {pipe}"), words);
    let model = "name = \"mine\"\nmodel = \"pipe\"\nmoves = 3\nheight = 9\nwidth = 9\nmax_steps = 9\n\
                 test_seeds = { start = 0, end = 1 }\n";
    std::fs::write(path("model.toml"), model).expect("write");
    let words = "model: expected a regular file, got a pipe";
    check(
        SERVER,
        &format!("--task {}", path("model.toml").display()),
        words,
    );
}
