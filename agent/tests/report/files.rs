//! Tests of the CSV file of runs: links, byte order marks, missing and unknown columns.

use super::synthetic::run;
use emberwatch_agent::benchmark::report::PolicyRun;
use emberwatch_agent::benchmark::report::runs_file::{check_runs_file, read_runs, write_runs};
use std::os::unix::fs::symlink;

#[test]
fn runs_are_read_back_as_the_same_numbers_and_replace_the_file_behind_a_link() {
    let folder = tempfile::tempdir().expect("a folder");
    let [path, link] = ["runs.csv", "link.csv"].map(|name| folder.path().join(name));
    write_runs(&path, &[run("first", "none", 0, 1.0)]).expect("written");
    symlink(&path, &link).expect("a link");
    check_runs_file(&link).expect("writable");
    let [beam, coverage] = [("beam", 2), ("coverage", 1)].map(|(policy, seed)| PolicyRun {
        mean_plan_millis: 1e-300,
        ..run(policy, "none", seed, 0.1 + 0.2)
    });
    write_runs(&link, &[coverage.clone(), beam.clone()]).expect("written");
    assert!(link.is_symlink());
    assert_eq!(folder.path().read_dir().expect("listed").count(), 2);
    assert_eq!(read_runs(&path).expect("rows"), [beam, coverage]);
    let text = std::fs::read_to_string(&path).expect("readable");
    assert!(text.starts_with(
        "policy,estimator,world_seed,steps,mean_reward,mean_distinct_cells,hit_rate,\
         mean_fire_cells,mean_plan_millis,brier,moves,robots,team,mean_repeated,\
         steps_to_detection,burning_cells_at_detection,burning_seen_share,front_distance,\
         grid_seen_share,log_likelihood,worlds_fingerprint,training_seconds\n"
    ));
    // Rows of other programs lack the last column, `training_seconds`, and have columns of their own. A byte order mark
    // does no harm.
    let cut = |line: &str| line.rsplit_once(',').map(|(line, _)| format!("{line},10"));
    let lines: Vec<String> = text.lines().filter_map(cut).collect();
    std::fs::write(&path, format!("\u{feff}{}", lines.join("\r\n"))).expect("written");
    let runs = read_runs(&path).expect("rows");
    assert_eq!((runs.len(), &*runs[0].policy), (2, "beam"));
    for text in ["not a table\nmine\n", "policy,steps\nmine,3\n"] {
        std::fs::write(&path, text).expect("written");
        let error = read_runs(&path).expect_err(text);
        assert!(format!("{error:#}").contains("runs.csv"), "{error:#}");
    }
}
