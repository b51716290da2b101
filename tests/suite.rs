//! `emberwatch-agent suite` and `leaderboard`: results that go on, one score, a page of entries.

use crate::commands::{agent, check, check_table};
use std::path::Path;
use tempfile::TempDir;
use tests::harness::AGENT;

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
        "entry coverage: expected the worlds and steps of task tiny",
    );
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
fn all_names_are_checked_before_anything_runs() {
    let folder = TempDir::new().expect("a folder");
    std::fs::write(folder.path().join("tiny.toml"), TASK).expect("write");
    let (task, out) = (folder.path().join("tiny.toml"), folder.path().join("out"));
    for tasks in [
        format!("{},jacksboro", task.display()),
        task.display().to_string(),
    ] {
        let suite = format!(
            "suite --tasks {tasks} --out {} --policies coverage,beam_xyz",
            out.display()
        );
        check(
            AGENT,
            &suite,
            "task tiny: policy: expected one of | got \"beam_xyz\"",
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
leaderboard --entries no/such => expected a folder of entries at no/such
leaderboard --policy mine => --add
leaderboard --add x --policy mine => --by";
    check_table(AGENT, table);
}
