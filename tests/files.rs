//! Tests of settings and model files. Errors name the path and the invalid entry; valid files are accepted.

use crate::commands::{agent, check};
use crate::trainings::COMPARED;
use tests::harness::{Folder, SERVER, SMALL, Server, repository, run};

#[test]
fn wrong_files_are_refused_by_path_and_entry() {
    let folder = Folder::default();
    for (flag, text, words) in [
        (
            "--config",
            "wrolds = 3\n",
            "PATH: wrolds: expected the name of a setting",
        ),
        ("--config", "worlds = = 3\n", "PATH | config file"),
        ("--model", "", "PATH | missing field"),
        ("--model", "name = ", "PATH | model file"),
    ] {
        let path = folder.write("wrong.toml", text);
        check(
            SERVER,
            &format!("{flag} {path} --check"),
            &words.replace("PATH", &path),
        );
    }
}

#[test]
fn documented_and_checked_settings_are_accepted_as_files() {
    let folder = Folder::default();
    let config = repository().join("config");
    let config = config.display();
    for flags in [
        "",
        "--start 3,5 --worlds 7 --coverage client --publish-truth --reveal-model false",
        "--start random --seed 9007199254740993 --max-steps 12 --burn-in 0",
        &format!("--model {config}/models/road-ice.toml --height 24 --width 40"),
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
    assert!(wildfire.contains("reward = 1.0, "));
    let pays = folder.write(
        "pays.toml",
        wildfire.replace("reward = 1.0", "reward = -1.0"),
    );
    let free = folder.write("free.toml", wildfire.replace("reward = 1.0, ", ""));
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
    let inside =
        format!("compare {COMPARED} --policies coverage --baseline coverage --model {free}");
    agent(&inside).check_says("no state pays");
}
