use super::synthetic::{run, teams};
use emberwatch_agent::benchmark::report::runs_file::{read_runs, write_runs};
use emberwatch_agent::benchmark::report::suite::{render_suite, scores};
use emberwatch_agent::benchmark::report::{PolicyRun, render_table};

/// Returns runs on worlds 1, 2, 3: `coverage` earns 1, 3, 5, `beam` earns 2, 5, 8, and the oracle earns 4, 8, 8.
fn three_policies() -> Vec<PolicyRun> {
    let mut runs = Vec::new();
    for (policy, estimator, rewards) in [
        ("coverage", "none", [1.0, 3.0, 5.0]),
        ("beam", "known", [2.0, 5.0, 8.0]),
        ("oracle_beam", "truth", [4.0, 8.0, 8.0]),
    ] {
        for (world, reward) in (1..).zip(rewards) {
            runs.push(run(policy, estimator, world, reward));
        }
    }
    runs
}

/// Returns the cells of a policy's row, after skipping `skip` earlier rows of that policy.
fn row(table: &str, policy: &str, skip: usize) -> Vec<String> {
    let is_row = |line: &&str| line.starts_with(&format!("| {policy} "));
    let line = table
        .lines()
        .filter(is_row)
        .nth(skip)
        .expect("a row of the policy");
    let cells = line.trim_matches('|').split('|');
    cells.map(|cell| cell.trim().to_string()).collect()
}

#[test]
fn a_table_gives_errors_over_worlds_and_paired_differences() {
    let mut runs = three_policies();
    // Shares are of the best oracle.
    let best = (1..).zip([5.0, 10.0, 10.0]);
    runs.extend(best.map(|(world, reward)| run("ahead", "truth", world, reward)));
    let table = render_table(&runs, "coverage");
    assert!(table.starts_with("3 worlds, 4 steps each; "), "{table}");
    // Standard errors: sqrt(18 / 2 / 3) = 1.73 for the rewards 2, 5, 8, and sqrt(2 / 2 / 3) = 0.58 for the differences.
    for (policy, expected) in [
        (
            "beam",
            "known 5.00 ± 1.73 +2.00 ± 0.58 60.0 0.250 60.0 0.1250 1.500",
        ),
        (
            "coverage",
            "none 3.00 ± 1.15 baseline 60.0 0.250 36.0 - 1.500",
        ),
        (
            "oracle_beam",
            "truth 6.67 ± 1.33 +3.67 ± 0.67 60.0 0.250 80.0 - 1.500",
        ),
    ] {
        assert_eq!(row(&table, policy, 0)[1..].join(" "), expected);
    }
}

#[test]
fn teams_are_compared_with_as_many_robots_alone() {
    let table = render_table(&teams(3), "beam");
    assert!(table.contains("to beam alone with as many robots"));
    // World w has the rewards 2 (w + 1) and 3 (w + 1). Standard error of the differences w + 1: sqrt(2 / 2 / 3) = 0.58.
    for (skip, expected) in [
        (2, "alone 2 4.00 ± 1.15 2.00 baseline 60.0 0.250 0.250"),
        (3, "joint 2 6.00 ± 1.73 3.00 +2.00 ± 0.58 60.0 0.250 0.125"),
    ] {
        assert_eq!(row(&table, "beam", skip)[2..10].join(" "), expected);
    }
    // One robot is not a team: the table has no columns for teams.
    assert!(!render_table(&teams(3)[..3], "beam").contains("team"));
}

/// Returns runs on three worlds. `beam` detects the fire in all three, and sees 0.5, 0.7 and 0.9 of it. `coverage`
/// detects it in two, and sees 0.3.
fn with_merit() -> Vec<PolicyRun> {
    let mut runs = three_policies();
    for (run, seen) in runs[3..6].iter_mut().zip([0.5, 0.7, 0.9]) {
        run.steps_to_detection = Some(run.world_seed);
        run.burning_cells_at_detection = Some(100);
        run.burning_seen_share = Some(seen);
        run.front_distance = Some(12.5);
    }
    for run in &mut runs[..3] {
        run.steps_to_detection = (run.world_seed > 1).then_some(40);
        run.burning_cells_at_detection = run.steps_to_detection.map(|_| 300);
        run.burning_seen_share = Some(0.3);
    }
    for run in &mut runs[..6] {
        (run.recent_steps, run.grid_seen_share) = (Some(25), Some(0.5));
    }
    runs
}

#[test]
fn figures_of_merit_say_in_how_many_worlds_fire_was_detected() {
    let mut runs = with_merit();
    let table = render_table(&runs, "coverage");
    assert!(table.contains("in the last 25 steps"), "{table}");
    // Standard errors: sqrt(2 / 2 / 3) = 0.6 for detection after 1, 2, 3 steps, and sqrt(800 / 2 / 3) = 11.5 for seen
    // shares of 50, 70, 90 % and their differences. A world without a detection has no detection time, and a world
    // without unseen fire has no distance. The oracle's rows are from an old file.
    for expected in [
        "beam 3 of 3 2.0 ± 0.6 100.0 ± 0.0 70.0 ± 11.5 +40.0 ± 11.5 12.5 ± 0.0 50.0 ± 0.0",
        "coverage 2 of 3 40.0 ± 0.0 300.0 ± 0.0 30.0 ± 0.0 baseline - 50.0 ± 0.0",
        "oracle_beam - - - - - - -",
    ] {
        let policy = expected.split(' ').next().expect("a policy");
        assert_eq!(row(&table, policy, 1).join(" "), expected);
    }
    assert!(!render_table(&three_policies(), "coverage").contains("merit"));
    assert!(!table.contains("no hidden states"));
    for run in &mut runs {
        (run.burning_seen_share, run.front_distance) = (None, None);
    }
    let table = render_table(&runs, "coverage");
    assert!(table.contains("no hidden states were published"), "{table}");
    assert_eq!(row(&table, "beam", 1)[4..7], ["-", "-", "-"]);
}

#[test]
fn tables_leave_out_what_there_is_not() {
    let mut runs = three_policies();
    runs.retain(|run| run.world_seed == 2);
    let table = render_table(&runs[..2], "nobody");
    for words in [
        "no standard error is possible",
        "baseline \"nobody\" was not run",
    ] {
        assert!(table.contains(words), "{table}");
    }
    assert!(!table.contains("% of oracle") && !table.contains("NaN"));
    assert_eq!(row(&table, "beam", 0)[2..4], ["5.00 (n = 1)", "-"]);
    let none = render_table(&[], "beam");
    assert_eq!(none, "No results: no policy was run.\n");
}

#[test]
fn csv_rows_read_back_as_the_same_numbers() {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("runs.csv");
    let mut runs = three_policies();
    runs[4].mean_reward = 0.1 + 0.2;
    runs[4].mean_plan_millis = 1e-300;
    write_runs(&path, &runs).expect("written");
    let text = std::fs::read_to_string(&path).expect("readable");
    assert!(text.starts_with(
        "policy,estimator,world_seed,steps,mean_reward,mean_distinct_cells,hit_rate,\
         mean_fire_cells,mean_plan_millis,brier,moves,robots,team,mean_repeated,\
         steps_to_detection,burning_cells_at_detection,recent_steps,burning_seen_share,front_distance,\
         grid_seen_share,log_likelihood,worlds_fingerprint,training_seconds\n"
    ));
    // Rows are sorted by policy and world.
    runs.sort_by(|a, b| (&a.policy, a.world_seed).cmp(&(&b.policy, b.world_seed)));
    assert_eq!(read_runs(&path).expect("rows"), runs);
}

#[test]
fn scores_of_tasks_lie_between_the_random_walk_and_the_oracle() {
    let task = |task: &str, rewards: &[(&str, [f64; 2])]| {
        let run = |policy: &str, seed, reward| PolicyRun {
            task: task.into(),
            ..run(policy, "known", seed, reward)
        };
        let of = |&(policy, [a, b]): &(&str, [f64; 2])| [run(policy, 0, a), run(policy, 1, b)];
        rewards.iter().flat_map(of).collect::<Vec<PolicyRun>>()
    };
    let (floor, ceiling) = (("random_walk", [0.0, 2.0]), ("oracle_ahead", [4.0, 6.0]));
    let (beam, own) = (("beam", [3.0, 3.0]), ("own", [1.0, 1.0]));
    let a = task("a", &[floor, ceiling, beam, own]);
    let b = task("b", &[floor, ceiling, ("beam", [2.0, 4.0])]);
    let table = render_suite(&[&*a, &b].concat());
    let expected = ["beam", "0.500", "0.500", "0.500 [0.250, 0.750]"];
    assert_eq!(row(&table, "beam", 0), expected);
    let (_, partial) = table
        .split_once("Policies that lack a task")
        .expect("two tables");
    assert_eq!(row(partial, "own", 0), ["own", "0.000", "-"], "{table}");
    // The second row of `beam` has its Brier scores.
    assert_eq!(row(&table, "beam", 1), ["beam", "0.1250", "0.1250"]);
    // If the oracle is not better than the random walk, there is no scale.
    let flat = task("flat", &[floor, ("oracle_ahead", [2.0, 0.0]), beam]);
    assert!(scores(&flat, "flat", "beam").is_empty());
    let table = render_suite(&[&*a, &flat].concat());
    assert_eq!(row(&table, "beam", 0), ["beam", "0.500", "-"], "{table}");
}
