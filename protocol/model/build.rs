//! Generates the tables of built-in models, tasks and recorded states that `src/built_in.rs` includes, from the folders
//! of `config/`.

use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};

fn main() {
    let text = |file: &Path| format!("include_str!({file:?})");
    write(
        "models",
        entries("models", "toml", |file| text(&with_maps(&file))),
    );
    write("tasks", entries("tasks", "toml", |file| text(&file)));
    let states = entries("landscapes", "", |folder| {
        let file = folder.join(folder.file_name().expect("a name"));
        let [archive, description] = ["npz", "toml"].map(|end| file.with_extension(end));
        format!("include_bytes!({archive:?}), {}", text(&description))
    });
    write("states", states);
}

/// Writes a model file with its maps in place of the name of their file, and returns its path.
fn with_maps(model: &Path) -> PathBuf {
    let text = fs::read_to_string(model).expect("a model file in UTF-8");
    let line = text.lines().find(|line| line.starts_with("maps = \""));
    let packed = line.map(|line| {
        let name = line.split('"').nth(1).expect("the name of a file");
        let archive = fs::read(model.with_file_name(name)).expect("a readable archive");
        let npz = BASE64.encode(archive);
        text.replace(line, &format!("maps = {{ npz = \"{npz}\" }}"))
    });
    let out = out().join(model.file_name().expect("a name"));
    fs::write(&out, packed.unwrap_or(text)).expect("write the model");
    out
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
    let file = out().join(kind).with_extension("rs");
    fs::write(file, format!("&[\n{}]\n", entries.concat())).expect("write the list");
}

fn out() -> PathBuf {
    std::env::var_os("OUT_DIR")
        .expect("cargo names a folder")
        .into()
}
