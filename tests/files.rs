//! Settings and model files: wrong ones are refused by path and entry, right ones run.

use crate::commands::{TINY, check};
use emberwatch_protocol::Model;
use tempfile::TempDir;
use tests::harness::{AGENT, SERVER, SMALL, Server, repository, run};

/// Files of wrong content, by name.
struct Files(TempDir);

impl Files {
    fn new() -> Self {
        Self(TempDir::new().expect("a folder"))
    }

    fn write(&self, name: &str, text: &str) -> String {
        let path = self.0.path().join(name);
        std::fs::write(&path, text).expect("write a file");
        path.to_str().expect("a plain path").into()
    }
}

/// Writes a file, names it with a flag, and checks that it is refused by its path.
fn check_file(flag: &str, text: &str, words: &str) {
    let files = Files::new();
    let path = files.write("wrong.toml", text);
    let words = format!("{path} | {words}");
    check(SERVER, &format!("{flag} {path} --check"), &words);
}

#[test]
fn wrong_settings_files_are_refused_by_path_and_entry() {
    check_file("--config", "wrolds = 3\n", "unknown field `wrolds`");
    check_file("--config", "worlds = 'three'\n", "invalid type | worlds");
    check_file("--config", "worlds = = 3\n", "config file");
}

#[test]
fn wrong_model_files_are_refused_by_path_and_entry() {
    let wildfire = repository().join("config/models/wildfire.toml");
    let wildfire = std::fs::read_to_string(wildfire).expect("the model file");
    let check = |from: &str, to: &str, words: &str| {
        assert!(wildfire.contains(from), "{from}");
        check_file("--model", &wildfire.replacen(from, to, 1), words);
    };
    check_file("--model", "", "missing field");
    check_file("--model", "name = ", "model file");
    check("name =", "colour = 1\nname =", "unknown field `colour`");
    check(
        "[[kernel]]",
        "[[kernel]]\nown = \"normal\"",
        "own in every entry, or in none, got 1 of 6",
    );
}

#[test]
fn a_model_that_can_divide_by_zero_on_the_grid_is_refused() {
    let files = Files::new();
    // A cell's weights come from the cell above it alone: the top row has none.
    let model = r##"
        name = "from-above"
        kernel_size = [3, 1]
        states = [
            { name = "a", color = "#000000", initial = 0.5, observed_as = [1.0] },
            { name = "b", color = "#ffffff", initial = 0.5, observed_as = [1.0] },
        ]
        observations = [{ name = "x", color = "#000000" }]
        kernel = [
            { from = "a", to = "a", weights = [[1.0], [0.0], [0.0]] },
            { from = "b", to = "b", weights = [[1.0], [0.0], [0.0]] },
        ]
    "##;
    let path = files.write("above.toml", model);
    let words = "from-above | cell (0, 0) can sum to zero | expected a positive sum";
    check(SERVER, &format!("--model {path}"), words);
    check(AGENT, &format!("compare {TINY} --model {path}"), words);
}

#[test]
fn the_checked_settings_are_accepted_again_as_a_file() {
    let files = Files::new();
    let model = repository().join("config/models/road-ice.toml");
    let model = model.to_str().expect("a plain path");
    for flags in [
        "",
        "--start 3,5 --worlds 7 --coverage client --publish-truth --reveal-model false",
        "--start random --seed 9007199254740993 --max-steps 12 --burn-in 0",
        &format!("--model {model} --height 24 --width 40"),
    ] {
        let first = run(SERVER, &format!("--check {flags}")).check(0);
        let path = files.write("settings.toml", &first.stdout);
        let second = run(SERVER, &format!("--check --config {path}")).check(0);
        assert_eq!(second.stdout, first.stdout);
    }
}

#[test]
fn a_model_in_which_no_state_pays_is_warned_of() {
    let wildfire = repository().join("config/models/wildfire.toml");
    let wildfire = std::fs::read_to_string(wildfire).expect("the model file");
    assert!(wildfire.contains("reward = 1.0"));
    let files = Files::new();
    for (reward, is_warned_of) in [("reward = -1.0", false), ("", true)] {
        let model = files.write("model.toml", &wildfire.replace("reward = 1.0", reward));
        let server = Server::start(&format!("{SMALL} --model {model}"));
        let log = server.program.stderr();
        assert_eq!(log.contains("no state pays"), is_warned_of, "{log}");
    }
}

#[test]
fn worlds_in_which_nothing_burns_are_warned_of_once() {
    for (burn_in, n_warnings) in [(0, 1), (3000, 0)] {
        let server = Server::start(&format!(
            "--worlds 3 --model wildfire-small --height 16 --width 16 --burn-in {burn_in}"
        ));
        let log = server.program.stderr();
        let found = log
            .matches("no cell is in the state that pays most")
            .count();
        assert_eq!(found, n_warnings, "{log}");
    }
}

#[test]
fn the_documented_files_are_accepted() {
    let check = |flag: &str, file: &str| {
        let path = repository().join("config").join(file);
        run(SERVER, &format!("--check {flag} {}", path.display())).check(0);
    };
    check("--config", "server.toml");
    for name in Model::built_in_names() {
        check("--model", &format!("models/{name}.toml"));
    }
}
