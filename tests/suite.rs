//! Tests of `emberwatch-agent suite` and `leaderboard`: results, the score, and the page of entries.

use crate::commands::{agent, check};
use emberwatch_agent::benchmark::report::PolicyRun;
use emberwatch_agent::benchmark::report::runs_file::read_runs;
use rustix::process::Signal;
use std::path::Path;
use tests::harness::{AGENT, Ended, Folder, LIMIT, Program, program_path};

const TASK: &str = "name = \"tiny\"
model = \"wildfire-small\"
height = 8
width = 9
moves = 5
burn_in = 300
max_steps = 40
test_seeds = { start = 0, end = 3 }
";

const PAGE: &str = "# Leaderboard\n\n<!-- made by `emberwatch-agent leaderboard` -->\n";

/// A folder with a task, results and entries.
struct Place(Folder);

impl Place {
    fn new() -> Self {
        let folder = Folder::default();
        folder.write("tiny.toml", TASK);
        folder.write("page.md", PAGE);
        std::fs::create_dir(folder.path("entries")).expect("a folder");
        Self(folder)
    }

    fn words(&self, flags: &str) -> String {
        let [task, out] = ["tiny.toml", "out"].map(|name| self.0.word(name));
        format!("suite --tasks {task} --out {out} {flags}")
    }

    fn suite(&self, flags: &str) -> Ended {
        agent(&self.words(flags))
    }

    fn rows(&self, policy: &str) -> Vec<PolicyRun> {
        let file = format!("out/tiny/{policy}.csv");
        read_runs(&self.0.path(&file)).expect("rows")
    }

    fn board(&self) -> String {
        let [entries, page] = ["entries", "page.md"].map(|name| self.0.word(name));
        format!("leaderboard --entries {entries} --page {page}")
    }

    fn entry(&self, policy: &str) -> String {
        let (board, out) = (self.board(), self.0.word("out"));
        format!("{board} --add {out} --policy {policy} --by us --code here --commit abcdef0")
    }
}

#[test]
fn a_suite_scores_all_policies_of_its_folder_and_makes_a_page() {
    let place = Place::new();
    let first = place.suite("--policies coverage");
    first.check_prints("| oracle_ahead | 1.000 |");
    let rows = place.rows("coverage");
    assert_eq!(rows.len(), 3);
    let more = place.suite("--policies known/beam/exploit,learned_beam");
    more.check_prints("| known/beam/exploit |");
    more.check_prints("| coverage ");
    more.check_says("learned_beam is not run: it needs a checkpoint");
    assert_eq!(place.rows("coverage"), rows);

    let early = place.entry("coverage");
    check(AGENT, &early, "expected an entry of random_walk");
    for policy in ["random_walk", "oracle_ahead", "known/beam/exploit"] {
        agent(&place.entry(policy));
    }
    let text = place.0.text("page.md");
    assert!(text.starts_with(PAGE) && text.contains("| us | here |"));
    assert!(place.0.text("page.svg").contains("\nknown/beam"));
    agent(&place.board());
    assert_eq!(place.0.text("page.md"), text, "the same digits");
    let none = "--add | expected results of \"mine\", got none";
    check(AGENT, &place.entry("mine"), none);
    let of_oracle = place.0.text("entries/oracle_ahead.csv");
    let other = of_oracle.replace(",alone,", ",shared,");
    place.0.write("entries/oracle_ahead.csv", other);
    let words = "entry oracle_ahead, task tiny: expected team alone, as in the entry of random_walk, got shared";
    check(AGENT, &place.board(), words);
    place.0.write("entries/oracle_ahead.csv", of_oracle);
    // A limit on file sizes simulates a full disk.
    let (program, board) = (program_path(AGENT), place.board());
    let script = format!(
        "trap '' XFSZ; ulimit -f 1; exec {} {board}",
        program.display()
    );
    let full = Program::start_at(Path::new("/bin/sh"), &["-c", &script]).wait(LIMIT);
    full.check(1).check_says("page.md: File too large");

    // Rows of another tool join the table, as long as they are of the same worlds.
    let own = place.0.text("out/tiny/coverage.csv");
    let rows = own.replace("coverage,", "python,");
    let others = place.0.write("out/tiny/python.csv", &rows);
    place.suite("--policies coverage").check_prints("| python ");
    let compare = format!(
        "compare --task {} --policies random_walk --baseline random_walk --add {others}",
        place.0.word("tiny.toml")
    );
    agent(&compare).check_prints("| python ");
    let of_python = "policy \"python\": expected world 0 for 40 steps, worlds_fingerprint";
    let changed = TASK.replace("burn_in = 300", "burn_in = 50");
    place.0.write("tiny.toml", changed);
    let changed = place.suite("--policies coverage");
    changed.check_says(&format!("python is left out: {of_python}"));
    assert!(!changed.stdout.contains("python"), "{}", changed.stdout);
    assert_eq!(place.0.text("out/tiny/python.csv"), rows, "none are lost");
    check(AGENT, &compare, &format!("--add: {of_python}"));
    check(AGENT, &place.entry("coverage"), "entry coverage, task tiny");
    assert!(!place.0.path("entries/coverage.csv").exists());
    assert_eq!(place.0.text("page.md"), text);
    place.0.write("out/tiny/python.csv", "policy\nmine\n");
    let words = "tiny.toml: | out/tiny/python.csv: expected a CSV file";
    check(AGENT, &place.words(""), words);
}

#[test]
fn a_suite_trains_what_its_policies_lack_and_leaves_gaps() {
    let folder = Folder::default();
    folder.write("tiny.toml", TASK);
    let recorded = "name = \"fires\"\nstates = \"jacksboro\"\nmoves = 8\nmax_steps = 10\n\
                    test_seeds = { start = 0, end = 2 }\n";
    folder.write("fires.toml", recorded);
    let words = |flags: &str| {
        let [tiny, fires, out, runs] =
            ["tiny.toml", "fires.toml", "out", "runs"].map(|name| folder.word(name));
        let policies =
            "learned_beam,learned_policy,neural_beam,known/beam/exploit,known/options/learned";
        format!(
            "suite --tasks {tiny},{fires} --out {out} --policies {policies} --checkpoints {runs} {flags}"
        )
    };
    let suite = |flags: &str| agent(&words(flags));
    // A training that was killed leaves nothing that counts.
    let flags = "--train --train-steps 100000000";
    let killed = Program::start(AGENT, &words(flags));
    let training = folder.path(&format!("runs/tiny/training.{}", killed.pid()));
    killed.until(|| training.exists());
    killed.wait_for_words("learning");
    killed.signal(Signal::TERM);
    killed.wait(LIMIT);
    assert!(!folder.path("runs/tiny/filter").exists());
    let first = suite("--train --train-steps 64");
    first.check_says("training filter for learned_beam");
    first.check_says("training decisions for learned_policy");
    first.check_says("task fires: known/options/learned is not run: it needs a known model");
    for task in ["tiny", "fires"] {
        let seconds = |policy: &str| {
            let runs = read_runs(&folder.path(&format!("out/{task}/{policy}.csv")));
            runs.expect("rows")[0].training_seconds.expect(policy)
        };
        assert!(seconds("neural_beam") > 0.0);
        assert!(seconds("learned_policy") >= seconds("learned_beam"));
        assert_eq!(seconds("random_walk"), 0.0);
    }
    // Complete trainings stay, whatever the flags.
    let again = suite("--train --train-steps 96");
    assert!(!again.stderr.contains(": training"), "{}", again.stderr);
    let checkpoint = folder.path("runs/tiny/filter/checkpoint.safetensors");
    // Without a checkpoint, a training begins anew.
    std::fs::remove_file(&checkpoint).expect("removed");
    suite("").check_says("learned_beam is not run: checkpoint ");
    // A folder that this command did not make stays.
    let refused = suite("--train --train-steps 64");
    refused.check_says("filter is in the way of the training for");
    std::fs::remove_dir_all(folder.path("runs/tiny/filter")).expect("removed");
    let anew = suite("--train --train-steps 64");
    anew.check_says("training filter for learned_beam");
    assert!(checkpoint.exists());
}
