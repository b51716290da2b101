//! The subcommand `prior`: what it writes is what a filter of the same settings begins with.

use emberwatch_belief::estimation::Prior;
use emberwatch_protocol::{Model, Probabilities, Shape};
use ndarray_npy::read_npy;
use std::path::Path;
use std::process::{Command, Output};
use tempfile::TempDir;

fn prior(folder: &Path, flags: &str) -> Output {
    prior_with_cache(folder, Path::new("/dev/null"), flags)
}

fn prior_with_cache(folder: &Path, cache: &Path, flags: &str) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_emberwatch-agent"));
    command.current_dir(folder).arg("prior");
    command.env("XDG_CACHE_HOME", cache);
    command.env("RUST_LOG", "info");
    command.args(flags.split_whitespace());
    command.output().expect("run the program")
}

#[test]
fn the_file_holds_the_belief_that_a_filter_begins_with() {
    let folder = TempDir::new().expect("a folder");
    let flags =
        "--model wildfire --height 5 --width 7 --burn-in 40 --worlds 9 --seed 3 --out p.npy";
    let path = folder.path().join("p.npy");
    std::fs::write(&path, "what was there before").expect("write");
    let ended = prior(folder.path(), flags);
    assert!(ended.status.success(), "{ended:?}");
    let written: Probabilities = read_npy(&path).expect("32-bit floats");
    let simulated = Prior::Simulated {
        n_worlds: 9,
        burn_in: 40,
    };
    let shape = Shape::new(5, 7).expect("test shape");
    let belief = simulated.belief(&Model::wildfire(), shape, 3);
    assert_eq!(&written, belief.expect("valid model").probabilities());
    let names: Vec<_> = std::fs::read_dir(folder.path())
        .expect("the folder")
        .map(|entry| entry.expect("an entry").file_name())
        .collect();
    assert_eq!(names, ["p.npy"], "nothing else is left");
}

#[test]
fn a_belief_is_simulated_once_and_again_where_its_file_is_no_good() {
    let folder = TempDir::new().expect("a folder");
    let cache = TempDir::new().expect("a folder");
    let flags = "--height 5 --width 7 --burn-in 40 --worlds 9";
    let run = |flags: &str| {
        let ended = prior_with_cache(
            folder.path(),
            cache.path(),
            &format!("--model wildfire --out p.npy {flags}"),
        );
        assert!(ended.status.success(), "{ended:?}");
        let is_simulated = String::from_utf8_lossy(&ended.stderr).contains("simulating");
        let written = std::fs::read(folder.path().join("p.npy"));
        (is_simulated, written.expect("a belief"))
    };
    let kept = || -> Vec<_> {
        let entries = std::fs::read_dir(cache.path().join("emberwatch/beliefs"));
        let path = |entry: std::io::Result<std::fs::DirEntry>| entry.expect("an entry").path();
        entries.expect("the folder").map(path).collect()
    };
    let first = run(flags);
    assert!(first.0);
    assert_eq!(run(flags), (false, first.1.clone()));
    let [file] = &kept()[..] else {
        panic!("expected a file, got {:?}", kept());
    };
    let bytes = std::fs::read(file).expect("the file");
    let mut flipped = bytes.clone();
    flipped[bytes.len() - 9] ^= 1;
    for wrong in [&bytes[1..], &flipped, b"", &[0; 1 << 20]] {
        std::fs::write(file, wrong).expect("write");
        assert_eq!(run(flags), first);
        assert_eq!(run(flags), (false, first.1.clone()));
    }
    std::fs::remove_file(file).expect("remove");
    std::fs::create_dir(file).expect("a folder in its place");
    assert_eq!(run(flags), first);
    std::fs::remove_dir(file).expect("remove");
    for other in [
        "--height 5 --width 7 --burn-in 40 --worlds 9 --seed 1",
        "--height 5 --width 7 --burn-in 40 --worlds 8",
        "--height 5 --width 7 --burn-in 41 --worlds 9",
        "--height 7 --width 5 --burn-in 40 --worlds 9",
    ] {
        assert!(run(other).0, "{other}");
    }
    assert_eq!(kept().len(), 4);
}
