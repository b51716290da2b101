//! ARCHITECTURE.md names every source file, and no file that is not there.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

const ARCHITECTURE: &str = include_str!("../../ARCHITECTURE.md");

/// Directories all of whose Rust, Python or JavaScript files are listed.
const SOURCES: [&str; 9] = [
    "protocol/src",
    "env-server/src",
    "agent/src",
    "agent/figures/src",
    "agent/network/src",
    "clients/dashboard/src",
    "clients/dashboard/page",
    "tests/src",
    "clients/python/src/emberwatch",
];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// The files of the list: a line without indent begins a directory, the others name a file in it.
fn listed() -> BTreeSet<String> {
    let (_, list) = ARCHITECTURE.split_once("```text\n").expect("a list");
    let (list, _) = list.split_once("\n```").expect("its end");
    let mut directory = "";
    let mut files = BTreeSet::new();
    for line in list.lines() {
        let (name, says) = line.trim().split_once(' ').expect("a name and its role");
        assert!(!says.trim().is_empty(), "{name} has no role");
        if line.starts_with(' ') {
            assert!(files.insert(format!("{directory}{name}")), "{name} twice");
        } else {
            directory = name;
        }
    }
    files
}

/// The source files below a directory, relative to the root.
fn source_files(directory: &str) -> Vec<String> {
    let entries = std::fs::read_dir(root().join(directory)).expect("a source directory");
    let below = |entry: std::io::Result<std::fs::DirEntry>| {
        let entry = entry.expect("a readable directory");
        let path = format!("{directory}/{}", entry.file_name().display());
        match entry.file_type().expect("a file type").is_dir() {
            true => source_files(&path),
            false => vec![path],
        }
    };
    let files = entries.flat_map(below);
    files.filter(|path| is_source(path)).collect()
}

fn is_source(name: &str) -> bool {
    [".rs", ".py", ".js"].iter().any(|end| name.ends_with(end))
}

#[test]
fn every_source_file_is_listed() {
    let listed = listed();
    let all: Vec<String> = SOURCES.into_iter().flat_map(source_files).collect();
    let missing: Vec<&String> = all.iter().filter(|path| !listed.contains(*path)).collect();
    assert!(
        all.len() > 80 && missing.is_empty(),
        "not listed: {missing:?}"
    );
}

#[test]
fn every_file_named_exists() {
    let listed = listed();
    let gone: Vec<&String> = listed
        .iter()
        .filter(|path| !root().join(path).is_file())
        .collect();
    assert!(gone.is_empty(), "not there: {gone:?}");
    // In the text, a file goes by the end of its path.
    let quoted = ARCHITECTURE.split('`').skip(1).step_by(2);
    for name in quoted.filter(|name| is_source(name)) {
        let end = format!("/{name}");
        let is_end = |path: &String| path == name || path.ends_with(&end);
        assert!(listed.iter().any(is_end), "{name} is not in the list");
    }
}
