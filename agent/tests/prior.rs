//! The subcommand `prior` writes the belief from which a filter with the same settings starts.

use emberwatch_belief::estimation::Prior;
use emberwatch_protocol::{Model, Probabilities, Shape};
use ndarray_npy::read_npy;
use std::process::Command;
use tempfile::TempDir;

#[test]
fn the_file_holds_the_belief_that_a_filter_begins_with() {
    let [folder, cache] = [(); 2].map(|()| TempDir::new().expect("a folder"));
    let path = folder.path().join("p.npy");
    std::fs::write(&path, "what was there before").expect("write");
    let shape = Shape::new(5, 7).expect("test shape");
    let simulated = Prior::Simulated {
        n_worlds: 9,
        burn_in: 40,
    };
    // The first belief is simulated once per seed, then read from the cache.
    for (seed, is_simulated) in [(3, true), (3, false), (4, true)] {
        let mut command = Command::new(env!("CARGO_BIN_EXE_emberwatch-agent"));
        command.current_dir(folder.path()).env("RUST_LOG", "info");
        command.env("XDG_CACHE_HOME", cache.path()).arg("prior");
        let flags =
            "--model wildfire --height 5 --width 7 --burn-in 40 --worlds 9 --out p.npy --seed";
        command.args(flags.split(' ')).arg(seed.to_string());
        let ended = command.output().expect("run the program");
        assert!(ended.status.success(), "{ended:?}");
        let log = String::from_utf8_lossy(&ended.stderr);
        assert_eq!(log.contains("simulating"), is_simulated, "{log}");
        let written: Probabilities = read_npy(&path).expect("32-bit floats");
        let belief = simulated.belief(&Model::wildfire(), shape, seed);
        assert_eq!(&written, belief.expect("valid model").probabilities());
        let names = std::fs::read_dir(folder.path()).expect("the folder");
        let names: Vec<_> = names.map(|it| it.expect("an entry").file_name()).collect();
        assert_eq!(names, ["p.npy"], "nothing else is left");
    }
}
