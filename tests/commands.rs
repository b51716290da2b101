//! Tests that invalid input to any command leads to an exit code and a one-line error, never to a panic.

use std::time::{Duration, Instant};
use tests::harness::{
    AGENT, Ended, Folder, LIMIT, Program, SERVER, SMALL, Server, new_instance, repository, run,
};

/// Flags of a very short comparison.
pub const TINY: &str = "--seeds 0..1 --steps 1 --height 4 --width 4 --moves 2 --burn-in 1 \
                    --policies coverage --baseline coverage";

/// Invalid flags of the server, and words of the resulting error.
const WRONG_SERVER_FLAGS: &str = r#"
--instance a/b => instance name | "a/b"
--worlds 1025 => '1025' | --worlds | expected 1 to 1024
--worlds 1024 --robots 5 => worlds times robots: expected 1 to 4096, got 5120
--worlds 1024 --height 4096 --width 4096 => memory: expected | MiB for 1024 worlds of 4096 x 4096 cells | got
--robots 64 --height 1000 --width 1000 => cells times robots: expected | got 64000000
--start 3,64 => start: expected a cell on the 64 x 64 grid, got (3, 64)
--exit-with 0 => --exit-with 0: expected a running process
--exit-with 4194305 => --exit-with 4194305: expected a running process
--model no/such.toml => model file no/such.toml: No such file
--config no/such.toml => config file no/such.toml: No such file
--config / => config file /: Is a directory
--config /dev/zero => config file /dev/zero: expected at most 16777216 bytes
--bogus => --bogus
status --instance nobody => no server on instance "nobody"
stop --instance nobody => no server on instance "nobody"
record => --out
record --out / => --out / | --force
record --out /no/such => --out /no/such: No such file
record --out /dev/null => --out | expected a new file | --force
record --worlds x --out o => --worlds | 'x'
"#;

/// Invalid flags of the agent, and words of the resulting error.
const WRONG_AGENT_FLAGS: &str = r#"
run --instance nobody --wait 0 => no server on instance "nobody"
run --wait soon => --wait | expected a number of seconds
run --steps-per-second 0.5 => --steps-per-second | expected 1 or more steps per second, got "0.5"
run --robots 3..3 => --robots | FIRST below END
run --robots some => --robots | expected FIRST..END
run --model no.toml => model file no.toml | No such file | expected a file, or one of | wildfire, wildfire-burnout
run --checkpoint /dev/zero => checkpoint /dev/zero: expected a regular file
run --config no.toml => config file no.toml | No such file
run --prior none => --prior | simulated, initial, uniform
run --beam-width 0 => beam_width: expected 1 to 10000, got 0
run --instance nobody --policy ash => policy: expected one of random_walk | BELIEF/PLANNER/GOAL | got "ash"
run --instance nobody --policy known/beam/ash --wait 0 => no server on instance "nobody"
run --instance nobody --policy known/beam/ash --model wildfire => "known/beam/ash": goal: expected one of | fire, got "ash"
compare --seeds 8..0 => --seeds | FIRST below END
compare --robots 1,65 => --robots | expected 1 to 64
compare --height 4 --burn-in 1 --policies coverage,coverage => each name once | got "coverage" twice
compare --height 4 --burn-in 1 --baseline ash => --baseline | expected one of | got "ash"
compare --instance nobody => no server on instance "nobody"
compare --checkpoint no/such => checkpoint no/such: No such file
train => --out
train --out /proc/no => create /proc/no
train --out OUT --worlds 0 => --worlds | 1..=1024
train --out OUT --instance nobody => no server on instance "nobody"
train --out OUT --instance x --height 9 => --instance | --height
train --out OUT --learner filtre => --learner | filter | 'filtre'
train --out OUT --world 3 => --instance
train --out OUT --resume --burn-in 1 => checkpoint OUT/checkpoint.safetensors: No such file
compare --instance x --height 9 => --instance | --height
compare --task small --moves 9 => moves: expected to be left out, as the task decides it, got 9
suite --tasks ash => task ash: No such file | expected a file, or one of wildfire, small
suite --tasks small,jacksboro --out OUT --policies coverage,known/beam/xyz => policy "known/beam/xyz": goal: expected one of | got "xyz"
suite --policies bem => policy: expected one of | got "bem"
suite --tasks small --checkpoints no/such => --checkpoints: expected a folder, got no/such
suite --train => --checkpoints
suite --checkpoints runs --train-steps 5 => --train
leaderboard --entries no/such => expected a folder of entries at no/such
leaderboard --policy mine => --add
leaderboard --add x --policy mine => --by
compare TINY --csv /proc/no/file.csv => create /proc/no
compare TINY --csv / => --csv: write /: expected a regular file, got a folder
compare TINY --csv /dev/null => --csv: write /dev/null: expected a regular file
compare TINY --csv /dev/null/rows.csv => --csv: /dev/null/rows.csv: create /dev/null
compare TINY --figures /proc => create /proc: expected a writable folder
"#;

/// Runs a program and checks that it fails with a one-line error that contains all words, separated by ` | `.
pub fn check(program: &str, arguments: &str, words: &str) {
    let Ended {
        code,
        stdout,
        stderr,
    } = run(program, arguments);
    let what = format!("{program} {arguments}: {code:?}: {stderr}");
    assert!(code.is_some_and(|code| code != 0), "{what}");
    assert!(!stderr.contains("panicked"), "{what}");
    assert_eq!(stdout, "", "{what}");
    let is_error = |line: &&str| line.starts_with("error: ") || line.contains(" ERROR ");
    assert_eq!(stderr.lines().filter(is_error).count(), 1, "{what}");
    for word in words.split(" | ") {
        assert!(stderr.contains(word), "{what} does not say {word:?}");
    }
}

/// Runs a command of the agent and checks that it succeeds.
pub fn agent(arguments: &str) -> Ended {
    let ended = run(AGENT, arguments).check(0);
    assert!(!ended.stderr.contains("ERROR"), "{}", ended.stderr);
    ended
}

/// Checks every line `flags => words | words` of a table. `TINY` stands for [`TINY`].
pub fn check_table(program: &str, table: &str) {
    for line in table.trim().lines() {
        let (flags, words) = line.split_once(" => ").expect("flags and words");
        check(program, &flags.replace("TINY", TINY), words);
    }
}

#[test]
fn wrong_flags_of_the_programs_are_named() {
    check_table(SERVER, WRONG_SERVER_FLAGS);
    let folder = Folder::default();
    check_table(
        AGENT,
        &WRONG_AGENT_FLAGS.replace("OUT", &folder.word("out")),
    );
    for (flag, text, words) in [
        (
            "--config",
            "wrolds = 3\n",
            "wrolds: expected the name of a setting",
        ),
        ("--config", "worlds = = 3\n", "config file"),
        ("--model", "", "missing field"),
    ] {
        let path = folder.write("wrong.toml", text);
        check(
            SERVER,
            &format!("{flag} {path} --check"),
            &format!("{path} | {words}"),
        );
    }
}

#[test]
fn checked_settings_are_accepted_as_a_file() {
    let folder = Folder::default();
    let model = repository().join("config/models/road-ice.toml");
    for flags in [
        "--start 3,5 --worlds 7 --coverage client --publish-truth --reveal-model false",
        "--start random --seed 9007199254740993 --max-steps 12 --burn-in 0",
        &format!("--model {} --height 24 --width 40", model.display()),
    ] {
        let first = run(SERVER, &format!("--check {flags}")).check(0);
        let path = folder.write("settings.toml", &first.stdout);
        let second = run(SERVER, &format!("--check --config {path}")).check(0);
        assert_eq!(second.stdout, first.stdout);
    }
}

#[test]
fn worlds_in_which_nothing_pays_or_burns_are_warned_of_once() {
    let folder = Folder::default();
    let wildfire = include_str!("../config/models/wildfire.toml");
    let [pays, free] = [("pays", "reward = -1.0, "), ("free", "")].map(|(name, reward)| {
        let model = wildfire.replace("reward = 1.0, ", reward);
        assert!(model != wildfire);
        folder.write(name, model)
    });
    let none_burns = "no cell is in the state with the highest reward";
    let lively = "--worlds 3 --model wildfire-small --height 16 --width 16 --burn-in";
    for (flags, words, n_warnings) in [
        (format!("{SMALL} --model {pays}"), "no state pays", 0),
        (format!("{SMALL} --model {free}"), "no state pays", 1),
        (format!("{lively} 0"), none_burns, 1),
        (format!("{lively} 3000"), none_burns, 0),
    ] {
        let log = Server::start(&flags).program.stderr();
        assert_eq!(log.matches(words).count(), n_warnings, "{log}");
    }
    agent(&format!("compare {TINY} --model {free}")).check_says("no state pays");
}

#[test]
fn a_server_that_does_not_fit_is_refused_with_what_is_missing() {
    for (settings, table) in [
        (
            "--reveal-model false --publish-truth",
            "run SERVER => does not reveal its model | --model FILE
train SERVER --out x --worlds 1 --learner decisions --estimator known => --reveal-model true
compare SERVER --policies coverage => instance | comparing needs the model | --reveal-model true",
        ),
        (
            "",
            "run SERVER --world 1 => no such world | worlds 0 to 0
run SERVER --robots 0..2 => robots: expected a part of the world's robots 0..1, got 0..2
run SERVER --policy known/beam/ash => goal: expected one of | fire, got \"ash\"
compare SERVER --policies coverage,oracle_beam => oracle_beam | --publish-truth
train SERVER --out x --worlds 1 --world 4294967294 => no such world: there are worlds 0 to 0",
        ),
    ] {
        let server = Server::start(&format!("{SMALL} {settings}"));
        check_table(AGENT, &table.replace("SERVER", &server.flag()));
    }
}

#[test]
fn status_and_a_second_server_report_the_first() {
    let server = Server::start(&format!("{SMALL} --worlds 2 --seed 40"));
    let words = format!("already running, as pid {}", server.program.pid());
    let flags = server.flag();
    check(SERVER, &flags, &words);
    let _client = server.acquire(1..2);
    let people = server.command("status").check(0);
    let holder = format!("pid {}", std::process::id());
    people.check_prints("41").check_prints(&holder);
    let json = server.command("status --json");
    let status: serde_json::Value = serde_json::from_str(&json.stdout).expect("JSON");
    assert_eq!(status["pid"], server.program.pid());
    assert_eq!(status["worlds"][1]["holder_pids"][0], std::process::id());
    assert_eq!(status["worlds"][1]["seed"], 41);
    server.command("stop").check(0);
    server.program.ends(0);
}

#[test]
fn an_agent_waits_for_the_server_that_is_started_with_it() {
    let instance = new_instance();
    let agent = Program::agent(&instance, "--steps 3 --wait 60");
    agent.wait_for_words("waiting up to");
    let _server = Server::start_on(&instance, SMALL);
    let ended = agent.ends(0);
    assert_eq!(ended.stderr.matches("waiting up to").count(), 1);
    let agent = Program::agent(&new_instance(), "--wait 1e18");
    agent.wait_for_words("waiting up to");
    agent.finish();
}

#[test]
fn an_agent_acts_as_slowly_as_it_is_told() {
    let server = Server::start(SMALL);
    let start = Instant::now();
    Program::agent(&server.instance, "--steps 3 --steps-per-second 2").ends(0);
    // Without pauses, three steps take a fraction of a second.
    assert!(start.elapsed() >= Duration::from_secs(1), "two pauses");
}

#[test]
fn refusals_quote_little_of_a_long_value() {
    let long = "x".repeat(3000);
    for (program, arguments) in [
        (SERVER, format!("--task {long}")),
        (SERVER, format!("--height {long}")),
        (SERVER, format!("--{long}")),
        (AGENT, format!("compare --policies {long}")),
        (AGENT, format!("train --out out --learner {long}")),
        ("emberwatch-dashboard", format!("--listen {long}")),
    ] {
        let ended = Program::start(program, &arguments).wait(LIMIT);
        assert_ne!(ended.code, Some(0), "{program}");
        let text = ended.stderr;
        assert!(
            text.len() < 1500 && !text.contains(&"x".repeat(81)),
            "{text}"
        );
    }
}
