//! `emberwatch-agent suite` and `leaderboard`: results that go on, one score, a page of entries.

use crate::commands::{agent, check, check_table};
use emberwatch_agent::benchmark::report::runs_file::read_runs;
use std::path::Path;
use tempfile::TempDir;
use tests::harness::{AGENT, LIMIT, Program, program_path, repository};

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

fn read(path: &Path) -> String {
    std::fs::read_to_string(path).expect("a file")
}

#[test]
fn a_suite_goes_on_and_its_results_make_a_page() {
    let folder = TempDir::new().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    std::fs::write(path("tiny.toml"), TASK).expect("write");
    let [task, out] = ["tiny.toml", "out"].map(|name| path(name).display().to_string());
    let suite = format!("suite --tasks {task} --out {out} --policies");
    let first = agent(&format!("{suite} coverage")).check(0);
    first.check_prints("| oracle_ahead | 1.000 |");
    let rows = read(&path("out/tiny.csv"));
    assert_eq!(rows.lines().count(), 1 + 3 * 3, "{rows}");
    // What is there is not run again: its plans took as long as before.
    let more = agent(&format!("{suite} coverage,beam_exploit,learned_beam")).check(0);
    more.check_prints("| beam_exploit |");
    let all = read(&path("out/tiny.csv"));
    assert_eq!(
        all.lines().count(),
        1 + 4 * 3,
        "a learned policy needs a checkpoint: {all}"
    );
    assert!(rows.lines().all(|row| all.contains(row)));
    more.check_says("3 rows of coverage kept");
    assert!(
        all.lines()
            .filter(|row| row.starts_with("beam"))
            .all(|row| !row.ends_with(',')),
        "likelihoods"
    );
    let fewer = agent(&format!("{suite} coverage --worlds 1")).check(0);
    fewer.check_prints("| coverage ");
    // Other settings give other rows.
    agent(&format!("{suite} coverage,beam_exploit --beam-width 2")).check(0);
    let narrow = read(&path("out/tiny.csv"));
    assert_ne!(
        of_policy(&narrow, "beam_exploit"),
        of_policy(&all, "beam_exploit")
    );
    agent(&format!("{suite} coverage,beam_exploit")).check(0);

    std::fs::create_dir(path("entries")).expect("a folder");
    std::fs::write(path("page.md"), PAGE).expect("write");
    let [entries, page] = ["entries", "page.md"].map(|name| path(name).display().to_string());
    let board = format!("leaderboard --entries {entries} --page {page}");
    let about = "--by us --code here --commit abcdef0 --training-seconds 5";
    let entry = |policy: &str| format!("{board} --add {out} --policy {policy} {about}");
    check(
        AGENT,
        &entry("coverage"),
        "expected an entry of random_walk",
    );
    for policy in ["random_walk", "oracle_ahead", "coverage", "beam_exploit"] {
        agent(&entry(policy)).check(0);
    }
    let text = read(&path("page.md"));
    assert!(
        text.starts_with(PAGE) && text.contains("| us | here |"),
        "{text}"
    );
    assert!(read(&path("page.svg")).contains("beam exploit"));
    agent(&board).check(0);
    assert_eq!(read(&path("page.md")), text, "the same digits");
    check(
        AGENT,
        &entry("mine"),
        "--add | expected results of \"mine\", got none",
    );
    let damaged = read(&path("entries/coverage.csv")).replacen(",40,", ",41,", 1);
    std::fs::write(path("entries/coverage.csv"), damaged).expect("write");
    check(
        AGENT,
        &board,
        "entry coverage, task tiny: policy \"coverage\" on world 0: steps: expected 40, got 41",
    );
}

#[test]
fn rows_of_other_worlds_are_run_again_left_out_or_refused() {
    let folder = TempDir::new().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    let [task, out, others] =
        ["tiny.toml", "out", "others.csv"].map(|name| path(name).display().to_string());
    std::fs::write(&task, TASK).expect("write");
    let suite = format!("suite --tasks {task} --out {out} --policies coverage");
    agent(&suite);
    // Rows that Python wrote on the same worlds.
    let rows = read(&path("out/tiny.csv"));
    let of_coverage = rows.lines().filter(|row| row.starts_with("coverage"));
    let python: Vec<String> = of_coverage
        .map(|row| row.replace("coverage", "python"))
        .collect();
    let header = rows.lines().next().expect("a header");
    std::fs::write(&others, format!("{header}\n{}\n", python.join("\n"))).expect("write");
    std::fs::write(
        path("out/tiny.csv"),
        format!("{rows}{}\n", python.join("\n")),
    )
    .expect("write");
    let same = agent(&suite).check(0);
    same.check_says("3 rows of coverage kept");
    same.check_prints("| python ");
    let compare = format!(
        "compare --task {task} --policies random_walk --baseline random_walk --add {others}"
    );
    agent(&compare).check_prints("| python ");
    let entries = path("entries");
    std::fs::create_dir(&entries).expect("a folder");
    std::fs::write(path("page.md"), PAGE).expect("write");
    let board = |policy: &str| {
        let [entries, page] = ["entries", "page.md"].map(|name| path(name).display().to_string());
        let about = "--by us --code here --commit abcdef0";
        format!(
            "leaderboard --entries {entries} --page {page} --add {out} --policy {policy} {about}"
        )
    };
    for policy in ["random_walk", "oracle_ahead", "python"] {
        agent(&board(policy));
    }
    let page = read(&path("page.md"));
    for (from, to, what) in [
        ("burn_in = 300", "burn_in = 50", "worlds_fingerprint"),
        ("moves = 5", "moves = 20", "moves: expected 20, got 5"),
        (
            "max_steps",
            "robots = 4\nmax_steps",
            "robots: expected 4, got 1",
        ),
        (
            "max_steps",
            "sensor_radius = 1\nmax_steps",
            "worlds_fingerprint",
        ),
        (
            "max_steps",
            "start = \"random\"\nmax_steps",
            "worlds_fingerprint",
        ),
        (
            "max_steps = 40",
            "max_steps = 41",
            "steps: expected 41, got 40",
        ),
    ] {
        std::fs::write(&task, TASK.replacen(from, to, 1)).expect("write");
        let changed = agent(&suite);
        changed.check_says("3 rows of coverage are run again");
        changed.check_says(&format!(
            "python is left out: policy \"python\" on world 0: {what}"
        ));
        assert!(!changed.stdout.contains("python"), "{}", changed.stdout);
        let rows = read(&path("out/tiny.csv"));
        assert!(python.iter().all(|row| rows.contains(row)), "none are lost");
        check(
            AGENT,
            &compare,
            &format!("--add: policy \"python\" on world 0: {what}"),
        );
        let refused = Program::start(AGENT, &board("coverage")).wait(LIMIT);
        assert_ne!(refused.code, Some(0));
        refused.check_says("entry coverage, task tiny");
        assert!(!entries.join("coverage.csv").exists());
        assert_eq!(read(&path("page.md")), page);
    }
}

#[test]
fn two_suites_that_fill_one_folder_at_once_lose_no_rows() {
    let folder = TempDir::new().expect("a folder");
    let [task, out] = ["tiny.toml", "out"].map(|name| folder.path().join(name));
    std::fs::write(&task, TASK).expect("write");
    let both = ["coverage", "beam_exploit"].map(|policy| {
        let (task, out) = (task.display(), out.display());
        let suite = format!("suite --tasks {task} --out {out} --policies {policy}");
        Program::start(AGENT, &suite)
    });
    both.into_iter().for_each(|suite| {
        suite.wait(LIMIT).check(0);
    });
    let runs = read_runs(&out.join("tiny.csv")).expect("rows");
    for policy in ["random_walk", "oracle_ahead", "coverage", "beam_exploit"] {
        let n_rows = runs.iter().filter(|run| run.policy == policy).count();
        assert_eq!(n_rows, 3, "{policy}");
    }
}

/// A copy of this repository's leaderboard in a folder.
struct Board(TempDir);

impl Board {
    fn new() -> Self {
        let folder = TempDir::new().expect("a folder");
        let docs = repository().join("docs");
        for name in ["random_walk", "oracle_ahead", "coverage"] {
            let name = format!("{name}.csv");
            let copied = std::fs::copy(
                docs.join("leaderboard").join(&name),
                folder.path().join(&name),
            );
            copied.expect("copied");
        }
        std::fs::write(folder.path().join("page.md"), PAGE).expect("write");
        Self(folder)
    }

    fn command(&self) -> String {
        let folder = self.0.path().display();
        format!("leaderboard --entries {folder} --page {folder}/page.md")
    }

    /// Checks that a changed entry is refused with these words, and leaves the page as it was.
    fn check(&self, change: impl Fn(&str) -> String, words: &str) {
        let path = self.0.path().join("coverage.csv");
        let entry = read(&path);
        let changed = change(&entry);
        assert_ne!(changed, entry, "{words}");
        std::fs::write(&path, changed).expect("write");
        check(AGENT, &self.command(), &format!("coverage | {words}"));
        assert_eq!(read(&self.0.path().join("page.md")), PAGE);
        std::fs::write(&path, entry).expect("write");
    }
}

#[test]
fn html_and_markdown_in_an_entry_are_refused_by_their_column() {
    let board = Board::new();
    let replace = |from: &'static str, to: &'static str| move |entry: &str| entry.replace(from, to);
    let by = ",Emberwatch,";
    board.check(
        replace(by, ",<svg onload=alert(2)>,"),
        "by: expected 1 to 200 letters",
    );
    board.check(replace(by, ",[us](javascript:alert(1)),"), "by: expected");
    board.check(
        replace(by, ",![us](https://example.org/us.png),"),
        "by: expected",
    );
    board.check(
        replace("agent/learning/src/policy/names.rs", "`code`"),
        "code: expected",
    );
    board.check(
        replace("agent/learning/src/policy/names.rs", "javascript:alert(1)"),
        "code: expected",
    );
    board.check(replace(",none,", ",<b>none</b>,"), "estimator: expected");
    board.check(
        replace(",small,", ",<img src=x>,"),
        "task: expected 1 to 64 letters",
    );
    board.check(
        replace("e82395e7", "<i>e82395e7"),
        "commit: expected 7 to 40",
    );
    let about = "--policy mine --by <svg> --code here --commit abcdef0 --training-seconds 0";
    let out = board.0.path().join("out");
    std::fs::create_dir(&out).expect("a folder");
    let rows = read(&repository().join("docs/learning/rows.csv"));
    let first = rows.lines().nth(1).and_then(|row| row.split(',').next());
    let rows = rows.replace(&format!("{},", first.expect("a policy")), "mine,");
    std::fs::write(out.join("small.csv"), rows).expect("write");
    let add = format!("{} --add {} {about}", board.command(), out.display());
    check(AGENT, &add, "by: expected 1 to 200 letters | got \"<svg>\"");
}

#[test]
fn an_entry_without_the_worlds_fingerprint_is_refused() {
    let board = Board::new();
    let without = |entry: &str| {
        let cut = |row: &str| row.rsplit_once(',').map(|(row, _)| row.to_owned());
        entry.lines().filter_map(cut).collect::<Vec<_>>().join("\n")
    };
    board.check(without, "worlds_fingerprint | got none");
    agent(&board.command()).check_prints("| coverage ");
}

#[test]
fn the_ends_of_the_scale_have_one_kind_of_team() {
    let board = Board::new();
    let path = board.0.path().join("oracle_ahead.csv");
    let entry = read(&path);
    std::fs::write(&path, entry.replace(",joint,", ",shared,")).expect("write");
    let words = "entry oracle_ahead, task team: expected team joint, as in the entry of random_walk, got shared";
    check(AGENT, &board.command(), words);
    std::fs::write(&path, entry.replace(",4,joint,", ",2,joint,")).expect("write");
    check(AGENT, &board.command(), "robots: expected 4, got 2");
}

#[test]
fn a_page_that_does_not_fit_on_the_disk_is_named() {
    let board = Board::new();
    // A limit of file sizes stands for a full disk.
    let script = format!(
        "trap '' XFSZ; ulimit -f 1; exec {} {}",
        program_path(AGENT).display(),
        board.command()
    );
    let ended = Program::start_at(Path::new("/bin/sh"), &["-c", &script]).wait(LIMIT);
    assert_eq!(ended.code, Some(1), "{}", ended.stderr);
    ended.check_says("page.md: File too large");
    assert_eq!(read(&board.0.path().join("page.md")), PAGE);
}

/// Rewards of a policy's rows.
fn of_policy(rows: &str, policy: &str) -> Vec<String> {
    let rows = rows.lines().filter(|row| row.starts_with(policy));
    let reward = |row: &str| row.split(',').nth(4).map(str::to_owned);
    rows.filter_map(reward).collect()
}

#[test]
fn a_policy_runs_again_on_what_was_learned_since() {
    let folder = TempDir::new().expect("a folder");
    let path = |name: &str| folder.path().join(name).display().to_string();
    std::fs::write(path("tiny.toml"), TASK).expect("write");
    let task = path("tiny.toml");
    let learn = |seed: u64, out: &str| {
        let flags = format!("--task {task} --worlds 2 --steps 40 --agent-seed {seed}");
        agent(&format!("train {flags} --out {out}/tiny")).check(0);
    };
    let (first, second, out) = (path("first"), path("second"), path("out"));
    learn(1, &first);
    learn(2, &second);
    let suite = |learned: &str| {
        let policies = "--policies learned_beam,coverage";
        agent(&format!(
            "suite --tasks {task} --out {out} --checkpoints {learned} {policies}"
        ))
        .check(0);
        read(Path::new(&out).join("tiny.csv").as_path())
    };
    let rows = suite(&first);
    assert_eq!(suite(&first), rows, "nothing ran again");
    let others = suite(&second);
    assert_ne!(
        of_policy(&others, "learned_beam"),
        of_policy(&rows, "learned_beam")
    );
    let of_coverage = |rows: &str| {
        let rows = rows.lines().filter(|row| row.starts_with("coverage"));
        rows.map(str::to_owned).collect::<Vec<_>>()
    };
    assert_eq!(
        of_coverage(&others),
        of_coverage(&rows),
        "coverage learned nothing"
    );
    let others = "--policies coverage --beam-width 3";
    let ended = agent(&format!("suite --tasks {task} --out {out} {others}"));
    ended.check_says("learned_beam is left out");
    assert!(!ended.stdout.contains("learned_beam"), "{}", ended.stdout);
}

#[test]
fn a_suite_trains_what_its_policies_lack_and_leaves_gaps() {
    let folder = TempDir::new().expect("a folder");
    let path = |name: &str| folder.path().join(name).display().to_string();
    std::fs::write(path("tiny.toml"), TASK).expect("write");
    let recorded = "name = \"fires\"\nstates = \"jacksboro\"\nmoves = 8\nmax_steps = 10\n\
                    test_seeds = { start = 0, end = 2 }\n";
    std::fs::write(path("fires.toml"), recorded).expect("write");
    let suite = |flags: &str| {
        let [tiny, fires, out, runs] = ["tiny.toml", "fires.toml", "out", "runs"].map(path);
        let policies = "learned_beam,learned_policy,neural_beam,beam_exploit,known/options/learned";
        agent(&format!(
            "suite --tasks {tiny},{fires} --out {out} --policies {policies} --checkpoints {runs} {flags}"
        ))
        .check(0)
    };
    let first = suite("--train --train-steps 64");
    first.check_says("task tiny: training filter for learned_beam, 0 of 64 world steps done");
    first.check_says("task fires: training decisions for learned_policy, 0 of 64 world steps");
    for policy in ["beam_exploit", "known/options/learned"] {
        let gap = "is not run: it needs a known model, and recorded worlds have none";
        first.check_says(&format!("task fires: {policy} {gap}"));
    }
    let seconds = |task: &str, policy: &str| {
        let runs = read_runs(&folder.path().join("out").join(task)).expect("rows");
        let run = runs.into_iter().find(|run| run.policy == policy);
        run.expect(policy).training_seconds.expect("kept")
    };
    for task in ["tiny.csv", "fires.csv"] {
        assert!(seconds(task, "neural_beam") > 0.0);
        assert!(seconds(task, "learned_policy") >= seconds(task, "learned_beam"));
        assert_eq!(seconds(task, "random_walk"), 0.0);
    }
    let again = suite("--train --train-steps 64");
    again.check_says("3 rows of learned_policy kept");
    assert!(!again.stderr.contains("training"), "{}", again.stderr);
    let narrow = suite("--train --train-steps 64 --beam-width 3");
    narrow.check_says("runs/tiny/filter is kept, although it was trained with other settings");
    let untrained = suite("");
    untrained.check_says(
        "neural_beam acts on an unfinished training: 64 of 48000 world steps (--learner neural)",
    );
    let longer = suite("--train --train-steps 96");
    longer.check_says("task tiny: training neural for neural_beam, 64 of 96 world steps done");
    longer.check_says("3 rows of neural_beam are run again");
    longer.check_says("tiny/decisions-learned_filter was learned on");
    longer.check_says("remove it to train the belief further");
    for policy in ["learned_beam", "learned_policy"] {
        assert!(longer.stdout.contains(policy), "its rows are kept");
    }
    let other = folder
        .path()
        .join("runs/tiny/filter/checkpoint.safetensors");
    let of_fires = folder
        .path()
        .join("runs/fires/filter/checkpoint.safetensors");
    std::fs::copy(of_fires, other).expect("another belief");
    let mixed = suite("");
    mixed.check_says("tiny/decisions-learned_filter was learned on another belief than");
}

#[test]
fn all_names_are_checked_before_anything_runs() {
    let folder = TempDir::new().expect("a folder");
    std::fs::write(folder.path().join("tiny.toml"), TASK).expect("write");
    let (task, out) = (folder.path().join("tiny.toml"), folder.path().join("out"));
    for tasks in [
        format!("{},jacksboro", task.display()),
        task.display().to_string(),
    ] {
        let suite = format!(
            "suite --tasks {tasks} --out {} --policies coverage,known/beam/xyz",
            out.display()
        );
        check(
            AGENT,
            &suite,
            "task tiny: policy \"known/beam/xyz\": goal: expected one of | got \"xyz\"",
        );
        assert!(!out.exists(), "nothing ran");
    }
}

#[test]
fn wrong_suites_and_entries_are_named() {
    let table = "suite --tasks ash => task ash: No such file | expected one, or wildfire, small
suite --policies bem => policy: expected one of | got \"bem\"
suite --worlds 0 => --worlds
suite --tasks small --checkpoints no/such => --checkpoints: expected a folder, got no/such
suite --train => --checkpoints
suite --checkpoints runs --train-steps 5 => --train
leaderboard --entries no/such => expected a folder of entries at no/such
leaderboard --policy mine => --add
leaderboard --add x --policy mine => --by";
    check_table(AGENT, table);
}
