//! Checks that ARCHITECTURE.md names every layer (folder of sources) and only existing files, that layers use only layers
//! below them, and that no files depend on each other in a cycle. The index of documents must be complete, and each
//! test file must be a module of its test program.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

const ARCHITECTURE: &str = include_str!("../../ARCHITECTURE.md");

/// Folders of sources. Each folder in them that contains source files is a layer.
const SOURCES: [&str; 17] = [
    "protocol/src",
    "protocol/messages/src",
    "protocol/model/src",
    "env-server/src",
    "env-server/sim/src",
    "agent/src",
    "agent/acting/src",
    "agent/belief/src",
    "agent/gradient/src",
    "agent/learning/src",
    "agent/network/src",
    "clients/c/src",
    "clients/dashboard/src",
    "clients/dashboard/page",
    "tests/src",
    "clients/python/native",
    "clients/python/src/emberwatch",
];

/// Lists the folders of crates.
fn crates() -> impl Iterator<Item = &'static str> {
    SOURCES.iter().filter_map(|name| name.strip_suffix("/src"))
}

/// The files of a crate, by module path from the root. Each file maps to the set of files on which it depends.
type Graph = BTreeMap<Vec<String>, BTreeSet<Vec<String>>>;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// Returns the layers in the order of the table.
fn layers() -> Vec<&'static str> {
    let rows = ARCHITECTURE.lines().filter(|line| line.starts_with("| `"));
    let layer = |row: &'static str| row.split('`').nth(1).expect("a layer");
    rows.map(layer).collect()
}

/// Returns the source files below a folder, relative to the root.
fn source_files(folder: &str) -> Vec<String> {
    let entries = std::fs::read_dir(root().join(folder)).expect("a source folder");
    let below = |entry: std::io::Result<std::fs::DirEntry>| {
        let entry = entry.expect("a readable folder");
        let path = format!("{folder}/{}", entry.file_name().display());
        if entry.file_type().expect("a file type").is_dir() {
            source_files(&path)
        } else {
            vec![path]
        }
    };
    let files = entries.flat_map(below);
    files.filter(|path| is_source(path)).collect()
}

fn is_source(name: &str) -> bool {
    [".rs", ".py", ".js"].iter().any(|end| name.ends_with(end))
}

/// Returns the layer of a source file: the topmost folder below the sources, or the sources themselves.
fn layer_of(path: &str) -> String {
    let of = |source: &&&str| path.starts_with(&format!("{source}/"));
    let source = SOURCES.iter().filter(of).max_by_key(|source| source.len());
    let source = source.expect("a folder of sources");
    match path[source.len() + 1..].split_once('/') {
        Some((folder, _)) => format!("{source}/{folder}"),
        None => (*source).to_owned(),
    }
}

#[test]
fn every_layer_is_listed_and_every_layer_and_file_named_exists() {
    let layers = layers();
    let files: Vec<String> = SOURCES.into_iter().flat_map(source_files).collect();
    // Folders that hold only a module's unit tests, contain layers or lie inside a layer need no row in the table.
    let sources = files.iter().filter(|path| !path.ends_with("/tests.rs"));
    let found: BTreeSet<String> = sources.map(|path| layer_of(path)).collect();
    let inner = [
        "agent/network/src/ops",
        "agent/network/src/dqn",
        "tests/src/fuzz",
    ];
    let needs_line = |layer: &&String| {
        let is_inside = |other: &String| other.starts_with(&format!("{layer}/"));
        !found.iter().any(is_inside) && !inner.contains(&layer.as_str())
    };
    for layer in found.iter().filter(needs_line) {
        assert!(layers.contains(&layer.as_str()), "{layer} is not listed");
    }
    assert!(files.len() > 80, "{files:?}");
    for layer in layers {
        assert!(root().join(layer).exists(), "{layer} does not exist");
    }
    let quoted = ARCHITECTURE.split('`').skip(1).step_by(2);
    for name in quoted.filter(|name| is_source(name)) {
        let end = format!("/{name}");
        let is_end = |path: &String| path == name || path.ends_with(&end);
        let exists = files.iter().any(is_end) || root().join(name).is_file();
        assert!(exists, "{name} does not exist");
    }
}

#[test]
fn the_index_of_documents_is_complete() {
    let folder = root().join("docs");
    let index = std::fs::read_to_string(folder.join("README.md")).expect("an index");
    let listed: BTreeSet<&str> = index.split('`').skip(1).step_by(2).collect();
    let gone = listed.iter().find(|name| !root().join(name).is_file());
    assert_eq!(gone, None);
    let files = std::fs::read_dir(folder).expect("a folder");
    let names = files.map(|file| format!("docs/{}", file.expect("a file").file_name().display()));
    let mut pages = names.filter(|name| name.ends_with(".md") && name != "docs/README.md");
    let missing = pages.find(|name| !listed.contains(name.as_str()));
    assert_eq!(missing, None);
}

#[test]
fn every_test_file_is_in_its_program() {
    let folders = crates().map(|name| root().join(name).join("tests"));
    let mut n_programs = 0;
    for folder in folders.chain([root().join("tests")]) {
        let Ok(program) = std::fs::read_to_string(folder.join("main.rs")) else {
            continue;
        };
        n_programs += 1;
        for entry in std::fs::read_dir(&folder).expect("a folder") {
            let file = entry.expect("a file").file_name().display().to_string();
            let is_module = |stem| {
                ["main", "decoders"].contains(&stem) || program.contains(&format!("mod {stem};"))
            };
            let is_in = file.strip_suffix(".rs").is_none_or(is_module);
            assert!(is_in, "{file} is not in {}/main.rs", folder.display());
        }
    }
    assert!(n_programs >= 9, "{n_programs} programs of tests");
}

#[test]
fn the_readme_shows_the_example_of_the_crate() {
    let example = |text: &'static str| {
        let (_, rest) = text.split_once("```rust,no_run\n").expect("an example");
        rest.split_once("```").expect("its end").0
    };
    let of_crate = example(include_str!("../README.md"));
    assert_eq!(example(include_str!("../../README.md")), of_crate);
}

#[test]
fn layers_use_only_those_below_them() {
    let layers = layers();
    for name in [
        "agent",
        "agent/acting",
        "agent/learning",
        "env-server",
        "env-server/sim",
    ] {
        let place = |module: &[String]| {
            let layer = format!("{name}/src/{}", module.first()?);
            layers.iter().position(|name| *name == layer)
        };
        for (file, used) in graph_of(name) {
            let Some(own) = place(&file) else { continue };
            let above = used
                .iter()
                .find(|used| place(used).is_some_and(|it| it < own));
            assert!(above.is_none(), "{name}: {file:?} uses {above:?}");
        }
    }
}

#[test]
fn pure_crates_need_no_channels_and_no_flags() {
    let pure = ["protocol/model", "protocol/messages", "env-server/sim"];
    for name in pure.into_iter().chain([
        "agent/acting",
        "agent/belief",
        "agent/gradient",
        "agent/learning",
    ]) {
        let manifest = std::fs::read_to_string(root().join(name).join("Cargo.toml"));
        let manifest = manifest.expect("a manifest");
        for other in ["iceoryx2", "clap", "tokio", "emberwatch-protocol"] {
            let is_named = manifest.lines().any(|line| line.starts_with(other));
            assert!(!is_named, "{name} uses {other}");
        }
    }
}

#[test]
fn no_crate_has_a_circle_of_files() {
    for name in crates() {
        assert_eq!(circles(graph_of(name)), Graph::new(), "{name}");
    }
    let n_edges: usize = graph_of("protocol").values().map(BTreeSet::len).sum();
    assert!(n_edges > 80, "{n_edges}: paths are not read");
}

#[test]
fn a_circle_is_found() {
    for (child, expected) in [
        ("use crate::b::B;", ""),
        ("use super::A;", " a a::c"),
        ("use crate::a::{A, B};", " a a::c"),
        ("fn f() -> crate::X {}", " a a::c"),
        ("#[cfg(test)]\nmod tests { use super::super::A; }", ""),
    ] {
        let texts = [
            ("", "pub mod a;\nmod b;\n#[cfg(test)]\nmod tests;"),
            ("a", "mod c;\nuse crate::b::{self, B};"),
            ("b", "// crate::a\nuse std::fmt; pub(crate) fn f() {}"),
            ("a::c", child),
        ];
        let texts = texts.map(|(name, text)| (module_of(name), text.to_owned()));
        let found = circles(graph(texts.into())).into_keys();
        let found: Vec<String> = found.map(|module| module.join("::")).collect();
        assert_eq!(found.join(" "), expected, "{child}");
    }
}

fn module_of(name: &str) -> Vec<String> {
    let names = name.split("::").filter(|name| !name.is_empty());
    names.map(str::to_owned).collect()
}

/// Returns the graph of a crate's library, without files of unit tests.
fn graph_of(name: &str) -> Graph {
    let source = format!("{name}/src");
    let mut texts = BTreeMap::new();
    for path in source_files(&source) {
        let Some(stem) = path[source.len() + 1..].strip_suffix(".rs") else {
            continue;
        };
        let module = module_of(&stem.replace('/', "::"));
        let last = module.last().expect("a name");
        if last == "main" || last.ends_with("tests") {
            continue;
        }
        let text = std::fs::read_to_string(root().join(&path)).expect("a readable file");
        let is_root = module == ["lib"];
        texts.insert(if is_root { Vec::new() } else { module }, text);
    }
    graph(texts)
}

/// Returns the files on which each file depends: its child modules, and every module named by a path that begins with
/// `crate`, `super` or `self`.
fn graph(texts: BTreeMap<Vec<String>, String>) -> Graph {
    let file_of = |path: &[String]| {
        let mut ends = (0..=path.len()).rev().map(|end| path[..end].to_vec());
        ends.find(|module| texts.contains_key(module))
    };
    let mut graph = Graph::new();
    for (module, text) in &texts {
        let named = paths(text, module);
        let mut used: BTreeSet<_> = named.iter().filter_map(|path| file_of(path)).collect();
        let is_child = |path: &&Vec<String>| path[..path.len().max(1) - 1] == module[..];
        let children = texts.keys().filter(is_child);
        used.extend(children.cloned());
        used.remove(module);
        graph.insert(module.clone(), used);
    }
    graph
}

/// Returns every path in the code that begins with `crate`, `super` or `self`. Paths are relative to the crate's root,
/// and end before a brace.
fn paths(text: &str, module: &[String]) -> Vec<Vec<String>> {
    let code = text.split("#[cfg(test)]\nmod tests").next();
    let lines = code.unwrap_or_default().lines();
    let lines = lines.map(|line| line.split("//").next().unwrap_or_default());
    let is_path = |letter: char| letter.is_alphanumeric() || "_:".contains(letter);
    let words = lines.flat_map(|line| line.split(move |letter: char| !is_path(letter)));
    let mut found = Vec::new();
    for word in words.filter(|word| word.contains("::")) {
        let mut path = module.to_vec();
        let mut names = word.split("::").filter(|name| !name.is_empty()).peekable();
        match names.next() {
            Some("crate") => path.clear(),
            Some("super") => drop(path.pop()),
            Some("self") => {}
            _ => continue,
        }
        while names.next_if_eq(&"super").is_some() {
            path.pop();
        }
        path.extend(names.map(str::to_owned));
        found.push(path);
    }
    found
}

/// Returns the files of circular dependencies, and those that use them.
fn circles(mut graph: Graph) -> Graph {
    loop {
        let files: BTreeSet<_> = graph.keys().cloned().collect();
        graph.retain(|_, used| !used.is_disjoint(&files));
        if graph.len() == files.len() {
            return graph;
        }
    }
}
