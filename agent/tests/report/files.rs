//! Tests of the CSV file of runs: links, byte order marks, missing and unknown columns.

use super::synthetic::run;
use emberwatch_agent::benchmark::report::runs_file::{check_runs_file, read_runs, write_runs};
use std::os::unix::fs::symlink;

#[test]
fn the_file_behind_a_link_is_replaced() {
    let folder = tempfile::tempdir().expect("a folder");
    let [path, link] = ["runs.csv", "link.csv"].map(|name| folder.path().join(name));
    write_runs(&path, &[run("first", "none", 0, 1.0)]).expect("written");
    symlink(&path, &link).expect("a link");
    check_runs_file(&link).expect("writable");
    write_runs(&link, &[run("second", "none", 0, 1.0)]).expect("written");
    assert!(link.is_symlink());
    assert_eq!(read_runs(&path).expect("rows")[0].policy, "second");
    assert_eq!(folder.path().read_dir().expect("listed").count(), 2);
}

#[test]
fn a_byte_order_mark_and_other_columns_do_no_harm() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("runs.csv");
    write_runs(&path, &[run("mine", "none", 0, 1.0)]).expect("written");
    let text = std::fs::read_to_string(&path).expect("rows");
    // Rows of other programs lack the last column, `training_seconds`, and have columns of their own.
    let cut = |line: &str| line.rsplit_once(',').map(|(line, _)| format!("{line},10"));
    let lines: Vec<String> = text.lines().filter_map(cut).collect();
    std::fs::write(&path, format!("\u{feff}{}", lines.join("\r\n"))).expect("written");
    let runs = read_runs(&path).expect("rows");
    assert_eq!((runs.len(), &*runs[0].policy), (1, "mine"));
    for text in ["not a table\nmine\n", "policy,steps\nmine,3\n"] {
        std::fs::write(&path, text).expect("written");
        let error = read_runs(&path).expect_err(text);
        assert!(format!("{error:#}").contains("runs.csv"), "{error:#}");
    }
}
