//! The subcommand `prior`: what it writes is what a filter of the same settings begins with.

use emberwatch_belief::estimation::Prior;
use emberwatch_protocol::{Model, Probabilities, Shape};
use ndarray_npy::read_npy;
use std::path::Path;
use std::process::{Command, Output};

fn prior(folder: &Path, flags: &str) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_emberwatch-agent"));
    command.current_dir(folder).arg("prior");
    command.args(flags.split_whitespace());
    command.output().expect("run the program")
}

#[test]
fn the_file_holds_the_belief_that_a_filter_begins_with() {
    let folder = tempfile::TempDir::new().expect("a folder");
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
