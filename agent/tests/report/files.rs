//! Tests of the CSV file of runs: several writers, old files, unwritable files.

use super::synthetic::run;
use emberwatch_agent::benchmark::report::RunsFile;
use emberwatch_agent::benchmark::report::runs_file::read_runs;
use std::os::unix::fs::symlink;
use std::path::Path;
use std::time::Duration;
use tempfile::TempDir;

const MINUTE: Duration = Duration::from_secs(60);

fn folder() -> TempDir {
    tempfile::tempdir().expect("a folder")
}

fn add(path: &Path, policy: &str) {
    let file = RunsFile::lock(path, MINUTE).expect("locked");
    let mut runs = file.read().expect("rows");
    runs.push(run(policy, "none", 0, 1.0));
    file.replace(&runs).expect("written");
}

fn names(folder: &TempDir) -> Vec<String> {
    let files = std::fs::read_dir(folder.path()).expect("listed");
    let name = |file: std::io::Result<std::fs::DirEntry>| file.expect("an entry").file_name();
    files.map(|file| name(file).display().to_string()).collect()
}

#[test]
fn many_writers_of_one_file_lose_no_rows() {
    let folder = folder();
    let path = folder.path().join("runs.csv");
    std::thread::scope(|scope| {
        for writer in 0..4 {
            let path = &path;
            scope.spawn(move || (0..5).for_each(|row| add(path, &format!("{writer}_{row}"))));
        }
    });
    assert_eq!(read_runs(&path).expect("rows").len(), 20);
    assert_eq!(names(&folder), ["runs.csv"]);
}

#[test]
fn a_file_that_another_writer_holds_is_refused_at_once() {
    let folder = folder();
    let path = folder.path().join("runs.csv");
    let first = RunsFile::lock(&path, Duration::ZERO).expect("locked");
    let error = RunsFile::lock(&path, Duration::ZERO).expect_err("held");
    let error = format!("{error:#}");
    assert!(
        error.contains("runs.csv: another process is writing it"),
        "{error}"
    );
    drop(first);
    RunsFile::lock(&path, Duration::ZERO).expect("free again");
}

#[test]
fn a_file_without_rows_is_removed_again() {
    let folder = folder();
    let path = folder.path().join("runs.csv");
    let file = RunsFile::lock(&path, Duration::ZERO).expect("locked");
    assert_eq!(
        (file.read().expect("no rows").len(), path.exists()),
        (0, true)
    );
    drop(file);
    assert!(names(&folder).is_empty());
    add(&path, "mine");
    drop(RunsFile::lock(&path, Duration::ZERO).expect("locked"));
    assert_eq!(read_runs(&path).expect("rows").len(), 1);
}

#[test]
fn the_file_behind_a_link_is_replaced() {
    let folder = folder();
    let [path, link] = ["runs.csv", "link.csv"].map(|name| folder.path().join(name));
    symlink(&path, &link).expect("a link");
    add(&link, "first");
    add(&path, "second");
    assert!(link.is_symlink());
    assert_eq!(read_runs(&link).expect("rows").len(), 2);
}

#[test]
fn files_with_a_byte_order_mark_and_of_older_releases_are_read() {
    let folder = folder();
    let path = folder.path().join("runs.csv");
    let mut team = run("mine", "none", 0, 1.0);
    team.robots = 4;
    let file = RunsFile::lock(&path, MINUTE).expect("locked");
    file.replace(&[team]).expect("written");
    let text = std::fs::read_to_string(&path).expect("rows");
    std::fs::write(&path, format!("\u{feff}{text}")).expect("written");
    let runs = read_runs(&path).expect("rows");
    assert_eq!((runs.len(), &*runs[0].policy), (1, "mine"));
    // An older file without fingerprints, then one without teams and figures of merit either.
    for (n_cut, robots) in [(4, 4), (14, 1)] {
        let cut = |line: &str| line.rsplitn(n_cut, ',').last().map(String::from);
        let old: Vec<String> = text.lines().filter_map(cut).collect();
        std::fs::write(&path, old.join("\r\n")).expect("written");
        let runs = read_runs(&path).expect("rows");
        assert_eq!((runs.len(), &*runs[0].worlds_fingerprint), (1, ""));
        assert_eq!((runs[0].robots, &*runs[0].team), (robots, "alone"));
    }
    for text in ["", "\u{feff}", "not a table\n", "policy,steps\nmine,3\n"] {
        std::fs::write(&path, text).expect("written");
        match read_runs(&path) {
            Ok(runs) => assert!(runs.is_empty(), "{text:?}"),
            Err(error) => assert!(format!("{error:#}").contains("runs.csv"), "{error:#}"),
        }
    }
}

#[test]
fn what_cannot_be_written_is_named_before_the_work() {
    let folder = folder();
    let file = folder.path().join("file");
    std::fs::write(&file, "").expect("written");
    for path in [
        Path::new("/proc/rows.csv"),
        Path::new("/dev/null"),
        folder.path(),
        &file.join("rows.csv"),
        &folder.path().join("missing/rows.csv"),
    ] {
        let error = RunsFile::lock(path, Duration::ZERO).expect_err("refused");
        let error = format!("{error:#}");
        assert!(error.contains(&path.display().to_string()), "{error}");
    }
}
