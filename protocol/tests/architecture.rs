//! ARCHITECTURE.md names every room and file rightly; rooms use only those below them; no file depends on itself by
//! way of others. The index of documents is complete.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

const ARCHITECTURE: &str = include_str!("../../ARCHITECTURE.md");

/// Folders of sources: each folder in them that has any is a room.
const SOURCES: [&str; 10] = [
    "protocol/src",
    "env-server/src",
    "agent/src",
    "agent/belief/src",
    "agent/figures/src",
    "agent/network/src",
    "clients/dashboard/src",
    "clients/dashboard/page",
    "tests/src",
    "clients/python/src/emberwatch",
];

const CRATES: [&str; 9] = [
    "protocol",
    "env-server",
    "agent",
    "agent/belief",
    "agent/figures",
    "agent/network",
    "clients/dashboard",
    "clients/python",
    "tests",
];

/// Each file with the files it depends on.
type Graph = BTreeMap<PathBuf, BTreeSet<PathBuf>>;

/// A crate's modules, from the root down, with their files.
type Modules = BTreeMap<Vec<String>, PathBuf>;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// The rooms of the table, in its order.
fn rooms() -> Vec<&'static str> {
    let rows = ARCHITECTURE.lines().filter(|line| line.starts_with("| `"));
    let room = |row: &'static str| row.split('`').nth(1).expect("a room");
    rows.map(room).collect()
}

/// The source files below a folder, relative to the root.
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

/// The room of a source file: the topmost folder below the sources, or these themselves.
fn room_of(path: &str) -> String {
    let of = |source: &&&str| path.starts_with(&format!("{source}/"));
    let source = SOURCES.iter().filter(of).max_by_key(|source| source.len());
    let source = source.expect("a folder of sources");
    match path[source.len() + 1..].split_once('/') {
        Some((folder, _)) => format!("{source}/{folder}"),
        None => (*source).to_owned(),
    }
}

#[test]
fn every_room_is_listed_and_exists() {
    let rooms: BTreeSet<&str> = rooms().into_iter().collect();
    let files: Vec<String> = SOURCES.into_iter().flat_map(source_files).collect();
    let found: BTreeSet<String> = files.iter().map(|path| room_of(path)).collect();
    // What only has thin roots beside folders, and folders of a room's own, need no line.
    let has_rooms = |room: &str| {
        found
            .iter()
            .any(|other| other.starts_with(&format!("{room}/")))
    };
    let inner = [
        "agent/network/src/ops",
        "agent/network/src/dqn",
        "tests/src/fuzz",
    ];
    let missing: Vec<&String> = found
        .iter()
        .filter(|room| !rooms.contains(room.as_str()) && !has_rooms(room))
        .filter(|room| !inner.contains(&room.as_str()))
        .collect();
    assert!(
        files.len() > 80 && missing.is_empty(),
        "not listed: {missing:?}"
    );
    let gone: Vec<&&str> = rooms
        .iter()
        .filter(|room| !root().join(room).exists())
        .collect();
    assert!(gone.is_empty(), "not there: {gone:?}");
}

#[test]
fn every_file_named_exists() {
    let files: Vec<String> = SOURCES.into_iter().flat_map(source_files).collect();
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
fn the_readme_shows_the_example_of_the_crate() {
    let example = |text: &'static str| {
        let (_, rest) = text.split_once("```rust,no_run\n").expect("an example");
        rest.split_once("```").expect("its end").0
    };
    let of_crate = example(include_str!("../README.md"));
    assert_eq!(example(include_str!("../../README.md")), of_crate);
}

#[test]
fn rooms_use_only_those_below_them() {
    let rooms = rooms();
    for name in ["agent", "env-server", "protocol"] {
        let source = root().join(name).join("src");
        let graph = graph(&source.join("lib.rs"), |path| {
            std::fs::read_to_string(path).ok()
        });
        let place = |file: &PathBuf| {
            let path = file.strip_prefix(root()).expect("below the root");
            let room = room_of(path.to_str().expect("a name"));
            let stem = path.with_extension("");
            let stem = stem.to_str().expect("a name");
            rooms.iter().position(|name| *name == room || *name == stem)
        };
        let edges = graph
            .iter()
            .flat_map(|(file, used)| used.iter().map(move |used| (file, used)));
        let upward: Vec<_> = edges
            .filter(|(file, used)| match (place(file), place(used)) {
                (Some(from), Some(to)) => to < from,
                _ => false,
            })
            .collect();
        assert!(upward.is_empty(), "{upward:#?}");
    }
}

#[test]
fn no_crate_has_a_circle_of_files() {
    let (mut n_edges, mut circles) = (0, Vec::new());
    for name in CRATES {
        for file in ["src/lib.rs", "src/main.rs"].map(|file| root().join(name).join(file)) {
            if file.is_file() {
                let graph = graph(&file, |path| std::fs::read_to_string(path).ok());
                n_edges += graph.values().map(BTreeSet::len).sum::<usize>();
                circles.extend(circle(&graph));
            }
        }
    }
    assert!(circles.is_empty(), "{circles:#?}");
    assert!(n_edges > 100, "{n_edges}: paths are not read");
}

#[test]
fn the_model_does_not_know_the_wire() {
    let source = root().join("protocol/src");
    let graph = graph(&source.join("lib.rs"), |path| {
        std::fs::read_to_string(path).ok()
    });
    let of_model = graph
        .iter()
        .filter(|(file, _)| file.starts_with(source.join("model")));
    let mut used = of_model.flat_map(|(_, used)| used).peekable();
    assert!(used.peek().is_some(), "the folder is not read");
    let outside = used.find(|used| !used.starts_with(source.join("model")));
    assert_eq!(outside, None);
}

#[test]
fn a_circle_is_found() {
    let check = |child: &str, expected: &[&str]| {
        let read = |path: &Path| match path.to_str()? {
            "lib.rs" => Some("pub mod a;\nmod b;\n#[cfg(test)]\nmod tests;".into()),
            "a.rs" => Some("mod c;\nuse crate::b::{self, B};".into()),
            "b.rs" => Some("// crate::a\nuse std::fmt;".into()),
            "a/c.rs" => Some(child.to_owned()),
            _ => None,
        };
        let found = circle(&graph(Path::new("lib.rs"), read)).unwrap_or_default();
        let found: Vec<&str> = found.iter().filter_map(|path| path.to_str()).collect();
        assert_eq!(found, expected, "{child}");
    };
    check("use crate::b::B;", &[]);
    check("use super::A;", &["a/c.rs", "a.rs"]);
    check("use crate::{b as d, a::{A, B}};", &["a/c.rs", "a.rs"]);
    check("fn f() -> crate::X {}", &["a/c.rs", "a.rs", "lib.rs"]);
    check("#[cfg(test)]\nmod tests { use super::super::A; }", &[]);
}

/// The files below a crate's root file, and what they depend on: child modules, and every module that a path names.
fn graph(root: &Path, read: impl Fn(&Path) -> Option<String>) -> Graph {
    let mut modules = Modules::from([(Vec::new(), root.to_owned())]);
    let mut texts = Vec::new();
    let mut unread = vec![Vec::new()];
    while let Some(module) = unread.pop() {
        let file = modules[&module].clone();
        let words = words(&read(&file).expect("a readable file"));
        for name in children(&words) {
            let child = [&module[..], &[name.to_owned()]].concat();
            let stem = root
                .parent()
                .expect("a folder")
                .join(child.iter().collect::<PathBuf>());
            let files = [stem.with_extension("rs"), stem.join("mod.rs")];
            let file = files.into_iter().find(|file| read(file).is_some());
            modules.insert(child.clone(), file.expect("a module's file"));
            unread.push(child);
        }
        texts.push((module, words));
    }
    let mut graph = Graph::new();
    for (module, words) in texts {
        let mut named: Vec<Vec<String>> = paths(&words, &module);
        named.extend(children(&words).map(|name| [&module[..], &[name.to_owned()]].concat()));
        let file = &modules[&module];
        let used = named.iter().map(|path| file_of(&modules, path));
        let used = used.filter(|used| used != file).collect();
        graph.insert(file.clone(), used);
    }
    graph
}

/// The file of the module that a path leads into.
fn file_of(modules: &Modules, path: &[String]) -> PathBuf {
    let mut ends = (0..=path.len()).rev();
    let file = ends.find_map(|end| modules.get(&path[..end]));
    file.expect("the root at least").clone()
}

/// Identifiers, `::` and single characters, without comments and unit tests.
fn words(text: &str) -> Vec<String> {
    let code: Vec<&str> = text
        .lines()
        .map(|line| line.split("//").next().unwrap_or_default())
        .collect();
    let code = code.join("\n");
    let code = code
        .split("#[cfg(test)]\nmod tests")
        .next()
        .unwrap_or_default();
    let mut words: Vec<String> = Vec::new();
    let mut last = ' ';
    for letter in code.chars() {
        let is_word = |letter: char| letter.is_alphanumeric() || letter == '_';
        match words.last_mut() {
            Some(word) if is_word(last) && is_word(letter) => word.push(letter),
            Some(word) if last == ':' && letter == ':' => word.push(letter),
            _ if letter.is_whitespace() => {}
            _ => words.push(letter.into()),
        }
        last = letter;
    }
    words
}

/// Names of the modules declared as files of their own.
fn children(words: &[String]) -> impl Iterator<Item = &str> {
    let declarations = words.windows(3);
    let declarations = declarations.filter(|three| three[0] == "mod" && three[2] == ";");
    declarations.map(|three| three[1].as_str())
}

/// Every path that begins with `crate`, `super` or `self`, from the crate's root.
fn paths(words: &[String], module: &[String]) -> Vec<Vec<String>> {
    let mut found = Vec::new();
    for at in 1..words.len() {
        let mut base = match words[at - 1].as_str() {
            "crate" => Vec::new(),
            "self" => module.to_vec(),
            "super" => module[..module.len().saturating_sub(1)].to_vec(),
            _ => continue,
        };
        if words[at] != "::" || (at > 1 && words[at - 2] == "::") {
            continue;
        }
        let mut rest = &words[at + 1..];
        while let ["super", "::", ..] = rest.iter().map(String::as_str).collect::<Vec<_>>()[..] {
            base.pop();
            rest = &rest[2..];
        }
        tree(rest, &base, &mut found);
    }
    found
}

/// The paths of a `use` tree; returns how many words it has.
fn tree(words: &[String], base: &[String], found: &mut Vec<Vec<String>>) -> usize {
    let mut path = base.to_vec();
    let mut at = 0;
    while words[at] != "{" {
        path.push(words[at].clone());
        at += 1;
        if words.get(at).is_none_or(|word| word != "::") {
            found.push(path);
            return at;
        }
        at += 1;
    }
    at += 1; // the brace
    while at < words.len() && words[at] != "}" {
        at += tree(&words[at..], &path, found).max(1);
        let rest = words[at..].iter();
        at += rest
            .take_while(|word| ![",", "}"].contains(&word.as_str()))
            .count(); // `as name`
        at += usize::from(words.get(at).is_some_and(|word| word == ","));
    }
    at + 1
}

/// The files of one circle, if there is one.
fn circle(graph: &Graph) -> Option<Vec<PathBuf>> {
    let reached = |from: &PathBuf| {
        let mut reached = BTreeSet::new();
        let mut next = vec![from];
        while let Some(file) = next.pop() {
            next.extend(
                graph[file]
                    .iter()
                    .filter(|used| reached.insert((*used).clone())),
            );
        }
        reached
    };
    let all: BTreeMap<&PathBuf, BTreeSet<PathBuf>> =
        graph.keys().map(|file| (file, reached(file))).collect();
    let start = graph.keys().find(|file| all[file].contains(*file))?;
    let in_circle = graph
        .keys()
        .filter(|file| all[start].contains(*file) && all[file].contains(start));
    Some(in_circle.cloned().collect())
}
