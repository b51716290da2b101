//! Tests of `emberwatch-agent suite` and `leaderboard`: resumed results, the score, and the page of entries.

use crate::commands::{agent, check, check_table};
use emberwatch_agent::benchmark::report::PolicyRun;
use emberwatch_agent::benchmark::report::runs_file::read_runs;
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

    fn suite(&self, flags: &str) -> Ended {
        let [task, out] = ["tiny.toml", "out"].map(|name| self.0.word(name));
        agent(&format!("suite --tasks {task} --out {out} {flags}"))
    }

    fn rows(&self) -> Vec<PolicyRun> {
        read_runs(&self.0.path("out/tiny.csv")).expect("rows")
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

fn rewards(rows: &[PolicyRun], policy: &str) -> Vec<f64> {
    let rows = rows.iter().filter(|run| run.policy == policy);
    rows.map(|run| run.mean_reward).collect()
}

#[test]
fn a_suite_goes_on_and_its_results_make_a_page() {
    let place = Place::new();
    let first = place.suite("--policies coverage");
    first.check_prints("| oracle_ahead | 1.000 |");
    let csv = || place.0.text("out/tiny.csv");
    let rows = csv();
    assert_eq!(rows.lines().count(), 1 + 3 * 3, "{rows}");
    // The policies of existing rows are not run again, so the planning times in these rows are unchanged.
    let more = place.suite("--policies coverage,beam_exploit,learned_beam");
    more.check_prints("| beam_exploit |");
    more.check_says("3 rows of coverage kept");
    assert_eq!(csv().lines().count(), 1 + 4 * 3, "learned_beam is left out");
    assert!(rows.lines().all(|row| csv().contains(row)));
    let all = place.rows();
    place.suite("--policies coverage,beam_exploit --beam-width 2");
    let narrow = rewards(&place.rows(), "beam_exploit");
    assert_ne!(narrow, rewards(&all, "beam_exploit"));

    let early = place.entry("coverage");
    check(AGENT, &early, "expected an entry of random_walk");
    for policy in ["random_walk", "oracle_ahead", "coverage", "beam_exploit"] {
        agent(&place.entry(policy));
    }
    let text = place.0.text("page.md");
    assert!(
        text.starts_with(PAGE) && text.contains("| us | here |"),
        "{text}"
    );
    assert!(place.0.text("page.svg").contains("\nbeam exploit"));
    agent(&place.board());
    assert_eq!(place.0.text("page.md"), text, "the same digits");
    let none = "--add | expected results of \"mine\", got none";
    check(AGENT, &place.entry("mine"), none);
    let named = place.entry("coverage").replace("--by us", "--by <svg>");
    check(AGENT, &named, "by: expected 1 to 200 letters");
    for (name, from, to, words) in [
        (
            "coverage",
            ",40,",
            ",41,",
            "world 0: steps: expected 40, got 41",
        ),
        ("coverage", ",none,", ",<b>none</b>,", "estimator: expected"),
        (
            "oracle_ahead",
            ",alone,",
            ",shared,",
            "task tiny: expected team alone, as in the entry of random_walk, got shared",
        ),
    ] {
        let file = format!("entries/{name}.csv");
        let entry = place.0.text(&file);
        let changed = entry.replacen(from, to, if name == "coverage" { 1 } else { 9 });
        assert_ne!(changed, entry, "{words}");
        place.0.write(&file, changed);
        check(AGENT, &place.board(), &format!("{name} | {words}"));
        place.0.write(&file, entry);
    }
    // A limit on file sizes simulates a full disk.
    let (program, board) = (program_path(AGENT), place.board());
    let script = format!(
        "trap '' XFSZ; ulimit -f 1; exec {} {board}",
        program.display()
    );
    let full = Program::start_at(Path::new("/bin/sh"), &["-c", &script]).wait(LIMIT);
    full.check(1).check_says("page.md: File too large");
    assert_eq!(place.0.text("page.md"), text, "as it was");
}

#[test]
fn rows_of_other_worlds_are_run_again_left_out_or_refused() {
    let place = Place::new();
    place.suite("--policies coverage");
    // Builds rows for the same worlds in the form in which the Python package writes them.
    let rows = place.0.text("out/tiny.csv");
    let of_coverage = rows.lines().filter(|row| row.starts_with("coverage"));
    let python: Vec<String> = of_coverage
        .map(|row| row.replace("coverage", "python"))
        .collect();
    let header = rows.lines().next().expect("a header");
    let text = python.join("\n");
    let others = place.0.write("others.csv", format!("{header}\n{text}\n"));
    place.0.write("out/tiny.csv", format!("{rows}{text}\n"));
    place.suite("--policies coverage").check_prints("| python ");
    let compare = format!(
        "compare --task {} --policies random_walk --baseline random_walk --add {others}",
        place.0.word("tiny.toml")
    );
    agent(&compare).check_prints("| python ");
    for policy in ["random_walk", "oracle_ahead", "python"] {
        agent(&place.entry(policy));
    }
    let page = place.0.text("page.md");
    for (from, to, what) in [
        ("burn_in = 300", "burn_in = 50", "worlds_fingerprint"),
        (
            "max_steps = 40",
            "max_steps = 41",
            "steps: expected 41, got 40",
        ),
    ] {
        place.0.write("tiny.toml", TASK.replacen(from, to, 1));
        let changed = place.suite("--policies coverage");
        changed.check_says("3 rows of coverage are run again");
        let of_python = format!("policy \"python\" on world 0: {what}");
        changed.check_says(&format!("python is left out: {of_python}"));
        assert!(!changed.stdout.contains("python"), "{}", changed.stdout);
        let rows = place.0.text("out/tiny.csv");
        assert!(python.iter().all(|row| rows.contains(row)), "none are lost");
        check(AGENT, &compare, &format!("--add: {of_python}"));
        check(AGENT, &place.entry("coverage"), "entry coverage, task tiny");
        assert!(!place.0.path("entries/coverage.csv").exists());
        assert_eq!(place.0.text("page.md"), page);
    }
}

#[test]
fn two_suites_that_fill_one_folder_at_once_lose_no_rows() {
    let place = &Place::new();
    std::thread::scope(|scope| {
        for policy in ["coverage", "beam_exploit"] {
            scope.spawn(move || place.suite(&format!("--policies {policy}")));
        }
    });
    let rows = place.rows();
    for policy in ["random_walk", "oracle_ahead", "coverage", "beam_exploit"] {
        assert_eq!(rewards(&rows, policy).len(), 3, "{policy}");
    }
}

#[test]
fn a_suite_trains_what_its_policies_lack_and_leaves_gaps() {
    let folder = Folder::default();
    folder.write("tiny.toml", TASK);
    let recorded = "name = \"fires\"\nstates = \"jacksboro\"\nmoves = 8\nmax_steps = 10\n\
                    test_seeds = { start = 0, end = 2 }\n";
    folder.write("fires.toml", recorded);
    let suite = |flags: &str| {
        let [tiny, fires, out, runs] =
            ["tiny.toml", "fires.toml", "out", "runs"].map(|name| folder.word(name));
        let policies = "learned_beam,learned_policy,neural_beam,beam_exploit,known/options/learned";
        agent(&format!(
            "suite --tasks {tiny},{fires} --out {out} --policies {policies} --checkpoints {runs} {flags}"
        ))
    };
    let first = suite("--train --train-steps 64");
    first.check_says("task tiny: training filter for learned_beam, 0 of 64 world steps done");
    first.check_says("task fires: training decisions for learned_policy, 0 of 64 world steps");
    for policy in ["beam_exploit", "known/options/learned"] {
        let gap = "is not run: it needs a known model, and recorded worlds have none";
        first.check_says(&format!("task fires: {policy} {gap}"));
    }
    for task in ["out/tiny.csv", "out/fires.csv"] {
        let runs = read_runs(&folder.path(task)).expect("rows");
        let seconds = |policy: &str| {
            let run = runs.iter().find(|run| run.policy == policy);
            run.expect(policy).training_seconds.expect("kept")
        };
        assert!(seconds("neural_beam") > 0.0);
        assert!(seconds("learned_policy") >= seconds("learned_beam"));
        assert_eq!(seconds("random_walk"), 0.0);
    }
    let again = suite("--train --train-steps 64 --beam-width 3");
    again.check_says("runs/tiny/filter is kept, although it was trained with other settings");
    assert!(
        !again.stderr.contains("training filter"),
        "{}",
        again.stderr
    );
    suite("").check_says(
        "neural_beam acts on an unfinished training: 64 of 48000 world steps (--learner neural)",
    );
    let longer = suite("--train --train-steps 96");
    for words in [
        "task tiny: training neural for neural_beam, 64 of 96 world steps done",
        "3 rows of neural_beam are run again",
        "3 rows of random_walk kept",
        "tiny/decisions-learned_filter was learned on",
        "remove it to train the belief further",
    ] {
        longer.check_says(words);
    }
    let checkpoint =
        |task: &str| folder.path(&format!("runs/{task}/filter/checkpoint.safetensors"));
    std::fs::copy(checkpoint("fires"), checkpoint("tiny")).expect("another belief");
    let mixed = suite("");
    mixed.check_says("tiny/decisions-learned_filter was learned on another belief than");
    mixed.check_says("rows of learned_beam are run again");
}

#[test]
fn wrong_suites_and_entries_are_named_before_anything_runs() {
    let place = Place::new();
    let table = "suite --tasks ash => task ash: No such file | expected a file, or one of wildfire, small
suite --tasks TINY,jacksboro --out OUT --policies coverage,known/beam/xyz => task tiny: policy \"known/beam/xyz\": goal: expected one of | got \"xyz\"
suite --policies bem => policy: expected one of | got \"bem\"
suite --worlds 0 => --worlds
suite --tasks small --checkpoints no/such => --checkpoints: expected a folder, got no/such
suite --train => --checkpoints
suite --checkpoints runs --train-steps 5 => --train
leaderboard --entries no/such => expected a folder of entries at no/such
leaderboard --policy mine => --add
leaderboard --add x --policy mine => --by";
    let table = table.replace("TINY", &place.0.word("tiny.toml"));
    check_table(AGENT, &table.replace("OUT", &place.0.word("out")));
    assert!(!place.0.path("out").exists(), "nothing ran");
}
