//! Generates the tables of built-in models, tasks and recorded states that `src/built_in.rs` includes, from the folders
//! of `config/`.

use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};

fn main() {
    let text = |file: &Path| format!("include_str!({file:?})");
    write("models", entries("models", "toml", |file| text(&file)));
    write("tasks", entries("tasks", "toml", |file| text(&file)));
    let states = entries("landscapes", "", |folder| {
        let file = folder.join(folder.file_name().expect("a name"));
        let [archive, description] = ["npz", "toml"].map(|end| file.with_extension(end));
        format!("include_bytes!({archive:?}), {}", text(&description))
    });
    write("states", states);
}

/// Lists the entries of a folder, sorted by name. Each entry is a Rust tuple of its name and `contents`. The entries
/// are the files with this extension, or the subfolders if `extension` is empty.
fn entries(folder: &str, extension: &str, contents: impl Fn(PathBuf) -> String) -> Vec<String> {
    println!("cargo:rerun-if-changed={folder}");
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join(folder);
    let files = fs::read_dir(&folder).unwrap_or_else(|error| {
        let place = folder.display();
        // The crates share the files of `config/` through symbolic links, which `cargo package` replaces by the files.
        println!(
            "cargo::error={place}: expected a symbolic link to a folder, got {error}: clone with symbolic links \
             (git clone -c core.symlinks=true; on Windows, in developer mode), not from a zip archive"
        );
        std::process::exit(1)
    });
    let mut files: Vec<PathBuf> = files
        .map(|entry| entry.expect("a readable folder").path())
        .filter(|path| path.extension().unwrap_or_default() == OsStr::new(extension))
        .filter(|path| path.is_dir() == extension.is_empty())
        .filter(|path| {
            !path
                .file_name()
                .is_some_and(|name| name.as_encoded_bytes().starts_with(b"."))
        })
        .collect();
    // Compares names without extension, so that `wildfire` comes before `wildfire-small`.
    files.sort_by(|a, b| a.file_stem().cmp(&b.file_stem()));
    let entry = |path: PathBuf| {
        let name = path.file_stem().and_then(OsStr::to_str);
        let name = name.expect("a name in UTF-8").to_owned();
        format!("({name:?}, {}),\n", contents(path))
    };
    files.into_iter().map(entry).collect()
}

fn write(kind: &str, entries: Vec<String>) {
    let out = std::env::var_os("OUT_DIR").expect("cargo names a folder");
    let file = Path::new(&out).join(kind).with_extension("rs");
    fs::write(file, format!("&[\n{}]\n", entries.concat())).expect("write the list");
}
